"""Sliders of expression over the head's shapes: eyes and lids look the same way, visemes differ."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.heads import make
from facepipe.heads.assembly import VISEMES
from facepipe.stage import Face


@pytest.fixture(scope="module")
def face() -> Face:
    return Face.from_parts(make())


def moved(face: Face, mesh: str, sliders: dict[str, float]) -> np.ndarray:
    """(n, 3) offsets of a mesh's points, mm."""
    return (face.split(face.evaluate(sliders=sliders))[mesh] - face.split(face.evaluate())[mesh]) * face.mm_per_unit


def test_there_is_every_viseme_of_oculus(face: Face) -> None:
    names = ["sil", "PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "I", "O", "U"]
    assert {slider.name for slider in face.sliders if slider.group == "visemes"} == {f"viseme_{name}" for name in names}


def test_visemes_are_told_apart_by_lips_and_tongue(face: Face) -> None:
    ways = {name: face.evaluate(sliders={f"viseme_{name}": 1.0}) for name in VISEMES}
    for name, points in ways.items():
        for other, others in ways.items():
            if name != other:
                assert np.linalg.norm(points - others, axis=1).max() * face.mm_per_unit > 1.0, (name, other)


@pytest.mark.parametrize(("slider", "axis"), [("lookLeft", 0), ("lookDown", 1)])
@pytest.mark.parametrize("value", [-1.0, 1.0])
def test_pupils_and_upper_lids_go_where_the_eyes_look(face: Face, slider: str, axis: int, value: float) -> None:
    sign = value if slider == "lookLeft" else -value
    for side in ("Left", "Right"):
        ball = face.split(face.evaluate())[f"Eyeball{side}"]
        pupil = ball[:, 2] > ball[:, 2].max() - 0.1
        assert moved(face, f"Eyeball{side}", {slider: value})[pupil, axis].mean() * sign > 3.0
    lids = moved(face, "Head", {slider: value})
    assert (lids[:, axis] * sign).max() > 1.0
    assert (lids[:, axis] * sign).max() > 2 * (-lids[:, axis] * sign).max()
