"""Sliders over bones: there are enough, each moves the face, and both sides alike."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.core.arrays import FloatArray
from facepipe.heads import make
from facepipe.heads.assembly import bone_sliders
from facepipe.stage import Face


@pytest.fixture(scope="module")
def face() -> Face:
    return Face.from_parts(make(0, controls="bones"))


@pytest.fixture(scope="module")
def mirror(face: Face) -> FloatArray:
    from scipy.spatial import cKDTree

    points = face.evaluate()
    return cKDTree(points).query(points * (-1, 1, 1))[1]


def test_there_are_at_least_30_and_their_names_are_their_own(face: Face) -> None:
    names = {slider.name for slider in bone_sliders()}
    assert len(names) == len(bone_sliders()) >= 30
    assert len({slider.name for slider in face.parts().sliders}) == len(face.parts().sliders)


@pytest.mark.parametrize("slider", [slider.name for slider in bone_sliders()])
def test_a_slider_moves_the_face_a_little_and_evenly(face: Face, mirror: FloatArray, slider: str) -> None:
    rest = face.evaluate()
    moved = face.evaluate(sliders={slider: 1.0}) - rest
    farthest = 10.0 * np.linalg.norm(moved, axis=1).max()
    assert 0.8 < farthest < 15.0  # mm
    uneven = np.linalg.norm(moved - moved[mirror] * (-1, 1, 1), axis=1)
    assert np.percentile(uneven, 99.9) < 0.05
