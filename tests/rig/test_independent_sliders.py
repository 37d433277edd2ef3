"""Sliders that are needed: mixes of others and the sides of a whole are not."""

from __future__ import annotations

from facepipe.parts import Slider
from facepipe.rig.sliders import independent


def kept(*sliders: Slider) -> set[str]:
    return {one.name for one, needed in zip(sliders, independent(sliders), strict=True) if needed}


WIDE = Slider(name="wide", shapes=(("wide", 1.0),), channels=(("eye", "tx", 0.2),))
LONG = Slider(name="long", shapes=(("long", 1.0),))
PAIR = tuple(
    Slider(name=f"up{side}", shapes=((f"up{side}", 1.0),), mirror=f"up{other}")
    for side, other in (("Left", "Right"), ("Right", "Left"))
)


def test_a_mix_of_others_is_not_needed() -> None:
    mix = Slider(name="mix", shapes=(("wide", 0.5), ("long", -0.3)), channels=(("eye", "tx", 0.1),))
    assert kept(WIDE, LONG, mix) == {"wide", "long"}
    more = Slider(name="more", shapes=(("wide", 0.5), ("long", -0.3)))  # without the eyes
    assert kept(WIDE, LONG, more) == {"wide", "long", "more"}


def test_sides_are_needed_where_nothing_does_both() -> None:
    assert kept(*PAIR) == {"upLeft", "upRight"}
    both = Slider(name="up", shapes=(("upLeft", 1.0), ("upRight", 1.0)))
    assert kept(*PAIR, both) == {"up"}


def test_a_slider_with_a_curve_is_kept() -> None:
    bent = Slider(name="bent", shapes=(("long", 1.0),), shape_curves=(((0.0, 0.0), (0.5, 0.1), (1.0, 1.0)),))
    assert kept(LONG, bent) == {"long", "bent"}
