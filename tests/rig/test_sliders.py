"""Sliders with curves and mirrors: what they do, and that files hold them exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faces import tiny_face
from hypothesis import given, settings
from hypothesis import strategies as st

import facepipe
from facepipe.core.errors import InputError, SchemaError
from facepipe.importers import usd as usd_importer
from facepipe.parts import FaceParts, Slider
from facepipe.rig import rest_coefficients, slide
from facepipe.rig.sliders import curve_fault, kept, sliders_fault, with_mutual_mirrors
from facepipe.stage import Face, save_parts
from facepipe.stage.author import author
from facepipe.stage.author_changes import author_changes

DECR, INCR = ((-1.0, 1.0), (0.0, 0.0)), ((0.0, 0.0), (1.0, 1.0))
BEND = ((-1.0, -0.25), (0.0, 0.125), (0.5, 0.125), (1.0, 3.0))
WIDTH = Slider(
    name="width",
    group="nose",
    minimum=-1.0,
    value=0.5,
    channels=(("root", "sx", 0.5), ("root/jaw", "rx", -0.25)),
    channel_curves=(None, BEND),
    shapes=(("jawOpen", 1.0), ("mouthSmileLeft", 0.75)),
    shape_curves=(DECR, INCR),
)
LEFT = Slider(name="browLeft", channels=(("root/jaw", "ty", 0.5),), mirror="browRight")
RIGHT = Slider(name="browRight", channels=(("root/jaw/lip", "ty", 0.5),), mirror="browLeft")


def tiny(*sliders: Slider) -> FaceParts:
    return replace(tiny_face(), sliders=sliders)


@pytest.mark.parametrize(
    ("value", "bend", "decrease", "increase"),
    [(-1, -0.25, 1, 0), (-0.5, -0.0625, 0.5, 0), (0, 0.125, 0, 0), (0.25, 0.125, 0, 0.25), (9, 3, 0, 1)],
)
def test_a_curve_is_straight_between_its_knots(value: float, bend: float, decrease: float, increase: float) -> None:
    coefficients, weights = slide((WIDTH,), ("root", "root/jaw"), {"width": value})
    expected = rest_coefficients(2)
    expected[0, 6] += 0.5 * min(value, 1)
    expected[1, 3] -= 0.25 * bend
    np.testing.assert_allclose(coefficients, expected, atol=1e-12)
    assert weights == pytest.approx({"jawOpen": decrease, "mouthSmileLeft": 0.75 * increase})


def test_a_curve_is_constant_beyond_its_ends() -> None:
    short = ((0.25, 2.0), (0.5, 1.0))
    slider = Slider(name="a", shapes=(("s", 1.0),), shape_curves=(short,))
    for value, amount in ((0.0, 2.0), (0.25, 2.0), (0.375, 1.5), (0.75, 1.0), (1.0, 1.0)):
        assert slide((slider,), (), {"a": value})[1] == {"s": amount}


def test_a_curve_along_the_diagonal_is_no_curve() -> None:
    """`gain * curve(value)` with curve(value) = value - default is the straight entry."""
    straight = Slider(name="a", default=0.25, channels=(("root", "tx", 3.0),))
    curved = replace(straight, channel_curves=(((0.0, -0.25), (1.0, 0.75)),))
    for value in np.linspace(-0.5, 1.5, 9):
        one, other = (slide((slider,), ("root",), {"a": value})[0] for slider in (straight, curved))
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_shape_weights_and_bones_are_as_the_face_evaluates_them() -> None:
    face = Face.from_parts(tiny(WIDTH))
    coefficients, weights = slide(face.sliders, face.skeleton.joints, {"width": -0.75})
    expected = face.evaluate(weights, coefficients=coefficients)
    np.testing.assert_array_equal(face.evaluate(sliders={"width": -0.75}), expected)
    assert np.abs(expected - face.evaluate()).max() > 0.1


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_files_hold_curves_and_mirrors_exactly(suffix: str, tmp_path: Path) -> None:
    sliders = (LEFT, RIGHT, replace(WIDTH, value=None), replace(WIDTH, name="width2", shape_curves=()))
    save_parts(tiny(*sliders), tmp_path / f"face{suffix}")
    assert facepipe.open(tmp_path / f"face{suffix}").sliders == sliders


KNOTS = st.lists(
    st.tuples(st.floats(-4, 4, width=32), st.floats(-100, 100, width=32)),
    min_size=2,
    max_size=5,
    unique_by=lambda k: k[0],
)


@st.composite
def curves(draw: st.DrawFn) -> Any:
    values, amounts = (sorted(column) for column in zip(*draw(KNOTS), strict=True))
    curve = tuple(zip(values, amounts[:: draw(st.sampled_from((1, -1)))], strict=True))
    return draw(st.sampled_from((curve, None)))


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_any_curves_round_trip(data: st.DataObject) -> None:
    channels = tuple(("root", channel, 0.5) for channel in data.draw(st.lists(st.sampled_from(("tx", "rz", "sy")))))
    shapes = tuple(("jawOpen", 0.25) for _ in range(data.draw(st.integers(0, 3))))
    slider = Slider(
        name="any",
        channels=channels,
        shapes=shapes,
        channel_curves=tuple(data.draw(curves()) for _ in channels),
        shape_curves=tuple(data.draw(curves()) for _ in shapes),
    )
    (found,) = Face.from_parts(tiny(slider)).sliders
    empty = {name: () for name in ("channel_curves", "shape_curves") if not any(getattr(slider, name))}
    assert found == replace(slider, **empty)


@pytest.mark.parametrize(
    "after",
    [
        (replace(WIDTH, channel_curves=()),),
        (replace(WIDTH, shape_curves=()),),
        (replace(WIDTH, channel_curves=(), shape_curves=()),),
        (replace(WIDTH, shape_curves=(INCR, None)),),
        (LEFT, RIGHT, WIDTH),
        (),
    ],
)
def test_overlays_change_curves_and_mirrors(after: tuple[Slider, ...], tmp_path: Path) -> None:
    for before, then in (((WIDTH,), after), (after, (WIDTH,)), ((LEFT, RIGHT), after)):
        save_parts(tiny(*before), tmp_path / "face.usda")
        with facepipe.open(tmp_path / "face.usda").deriving(tmp_path / "over.usda") as face:
            author_changes(face, replace(face.parts(), sliders=then))
        assert facepipe.open(tmp_path / "over.usda").sliders == then


def test_an_unchanged_curve_authors_nothing(tmp_path: Path) -> None:
    save_parts(tiny(WIDTH), tmp_path / "face.usda")
    with facepipe.open(tmp_path / "face.usda").deriving(tmp_path / "over.usda") as face:
        assert author_changes(face, face.parts()) == ()


NAN, INF = float("nan"), float("inf")
FAULTS: dict[str, tuple[Any, str]] = {
    "no knot": ((), "0 knots"),
    "one knot": (((0.0, 1.0),), "1 knots"),
    "no pair": (((0.0, 1.0, 2.0), (1.0, 1.0, 2.0)), "a value and an amount"),
    "a value twice": (((0.0, 0.0), (0.0, 1.0)), "ascending"),
    "twice in float32": (((1.0, 0.0), (1.0 + 1e-9, 1.0)), "ascending"),
    "descending": (((0.0, 0.0), (1.0, 0.5), (0.5, 1.0)), "1, 0.5 of a curve"),
    "turns back": (((0.0, 0.0), (0.5, 1.0), (1.0, 0.5)), "rises and falls"),
    "NaN value": (((NAN, 0.0), (1.0, 1.0)), "NaN or infinity"),
    "NaN amount": (((0.0, 0.0), (1.0, NAN)), "NaN or infinity"),
    "beyond float32": (((0.0, 0.0), (1.0, 1e39)), "NaN or infinity"),
    "endless": (((-INF, 0.0), (1.0, 1.0)), "NaN or infinity"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_damaged_curves_are_refused_by_all_who_take_sliders(name: str) -> None:
    curve, message = FAULTS[name]
    assert message in (curve_fault(curve) or "")
    slider = Slider(name="open", shapes=(("jawOpen", 1.0),), shape_curves=(curve,))
    with pytest.raises(InputError, match=message) as caught:
        slide((slider,), ())
    assert "slider open" in str(caught.value)
    with pytest.raises(InputError, match="open"):
        author(tiny(slider))


def test_curves_that_are_not_parallel_are_refused() -> None:
    slider = Slider(name="open", shapes=(("jawOpen", 1.0),), shape_curves=(INCR, INCR))
    with pytest.raises(InputError, match="2 curves of shapes, expected none or 1"):
        slide((slider,), ())
    with pytest.raises(InputError, match="2 curves of shapes, expected none or 1"):
        author(tiny(slider))


@pytest.mark.parametrize(
    ("sliders", "message"),
    [
        ((LEFT,), "browLeft: mirror 'browRight', expected the name of another slider"),
        ((LEFT, replace(RIGHT, mirror=None)), "browLeft: mirror 'browRight', whose mirror is ''"),
        ((replace(LEFT, mirror="browLeft"),), "expected the name of another slider"),
        ((LEFT, replace(RIGHT, name="other"), replace(RIGHT, mirror="other")), "whose mirror is 'other'"),
    ],
)
def test_mirrors_are_mutual(sliders: tuple[Slider, ...], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        author(tiny(*sliders))
    save_parts(tiny(), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    with pytest.raises(InputError, match=message):
        author_changes(face, replace(face.parts(), sliders=sliders))
    mended = with_mutual_mirrors(sliders)
    assert sliders_fault(mended) is None
    assert [one.name for one in mended] == [slider.name for slider in sliders]
    assert with_mutual_mirrors((LEFT, RIGHT)) == (LEFT, RIGHT)


def damaged(**values: object) -> Callable[[Face], None]:
    def damage(face: Face) -> None:
        for name, value in values.items():
            assert face.prim.GetAttribute(f"facepipe:slider:width:{name}").Set(value)

    return damage


READ_FAULTS: dict[str, tuple[Callable[[Face], None], str]] = {
    "too few counts": (damaged(channelKnots=[4]), "channelKnots: 1 counts, expected none or 2"),
    "too many counts": (damaged(shapeKnots=[2, 2, 0]), "shapeKnots: 3 counts, expected none or 2"),
    "a negative count": (damaged(shapeKnots=[-2, 6]), "shapeKnots: a count of knots that is negative or 1"),
    "a count of 1": (damaged(shapeKnots=[1, 3]), "shapeKnots: a count of knots that is negative or 1"),
    "counts beyond the knots": (damaged(channelKnots=[2**31 - 1, 4]), "8 knot values and 8 amounts, expected"),
    "too few values": (damaged(knotValues=[0.0] * 7), "7 knot values and 8 amounts, expected 8 of each"),
    "knots without counts": (damaged(channelKnots=[], shapeKnots=[]), "8 knot values and 8 amounts, expected 0"),
    "descending": (damaged(knotValues=[1.0, 0.0] * 4), "expected them strictly ascending"),
    "turning": (damaged(knotAmounts=[0.0, 1.0] * 4), "rises and falls"),
    "NaN": (damaged(knotAmounts=[NAN] * 8), "NaN or infinity"),
    "unknown mirror": (damaged(mirror="nobody"), "mirror 'nobody', expected the name of another slider"),
    "not mutual": (damaged(mirror="browLeft"), "mirror 'browLeft', whose mirror is 'browRight'"),
}


@pytest.mark.parametrize("name", READ_FAULTS)
def test_damaged_lists_on_a_stage_give_one_line(name: str, tmp_path: Path) -> None:
    damage, message = READ_FAULTS[name]
    save_parts(tiny(LEFT, RIGHT, WIDTH), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    damage(face)
    with pytest.raises(SchemaError) as caught:
        _ = face.sliders
    assert message in str(caught.value)
    assert str(caught.value).startswith("face.usda -> ")
    assert "slider:width" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_import_keeps_curves_with_their_shapes_and_mirrors_that_are_mutual(tmp_path: Path) -> None:
    stray = replace(RIGHT, channels=(("nobody", "tx", 1.0),))
    parts = tiny(LEFT, stray, replace(WIDTH, shapes=(("lost", 1.0), ("mouthSmileLeft", 0.75))))
    save_parts(parts, tmp_path / "face.usda")
    found = usd_importer.read(tmp_path / "face.usda", usd_importer.Options()).parts.sliders
    width = replace(WIDTH, shapes=(("mouthSmileLeft", 0.75),), shape_curves=(INCR,))
    assert found == (replace(LEFT, mirror=None), width)


def test_entries_left_out_take_their_curves_along() -> None:
    rest = kept(WIDTH, lambda joint: joint == "root", lambda shape: shape == "mouthSmileLeft")
    assert rest.channels == (("root", "sx", 0.5),)
    assert rest.channel_curves == ()
    assert (rest.shapes, rest.shape_curves) == ((("mouthSmileLeft", 0.75),), (INCR,))
