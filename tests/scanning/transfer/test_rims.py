"""Rims of eyes and mouth on a head's own mesh, where they are known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from transfer_template import skin, template

from facepipe.geometry.registration import Anchors
from facepipe.scanning.transfer.mesh import HeadMesh
from facepipe.scanning.transfer.places import REACH_MM, nearest_places
from facepipe.scanning.transfer.rims import rim_anchors
from facepipe.scanning.transfer.sides import sides_on

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


@pytest.fixture(scope="module", autouse=True)
def made_before() -> None:
    """The head is made before the first test, not in it."""
    assert len(template().seen)


def found(points: FloatArray, triangles: IntArray) -> tuple[Anchors, IntArray]:
    """Rims of a head on which the template lies as it is, and the template's sides."""
    rows, _ = skin()
    head = HeadMesh.of(points, triangles)
    labels, sides = sides_on(template(), rows, head, nearest_places(rows, template().triangles, head), REACH_MM)
    return rim_anchors(template(), rows, head, labels, sides), labels


def test_on_its_own_mesh_rims_stay() -> None:
    points, triangles = skin()
    seen = np.isin(np.arange(len(points)), template().seen)
    anchors, labels = found(points, triangles[seen[triangles].all(axis=1)])
    assert {2, -2, 3, -3} <= set(labels[anchors.corners].ravel().tolist())
    assert len(anchors) >= 16
    np.testing.assert_allclose(anchors.targets, anchors.places(points), rtol=0, atol=1e-9)


def test_a_lower_upper_lid_is_found_as_much_lower() -> None:
    points, triangles = skin()
    *_, labels = found(points, triangles)
    shut = np.array(points)
    shut[labels == 2] -= [0.0, 1.5, 0.0]
    anchors, _ = found(shut, triangles)
    moves = anchors.targets - anchors.places(points)
    lids = labels[anchors.corners[:, 0]]
    assert np.count_nonzero(lids == 2) >= 6
    assert abs(np.median(moves[lids == 2, 1]) + 1.5) < 0.2
    assert np.abs(moves[np.isin(lids, (-2, 3, -3)), 1]).max() < 0.2


def test_eyes_filled_with_triangles_are_not_open() -> None:
    """As on masks: the lids' points are joined across the eye, and no longer round it."""
    points, triangles = skin()
    *_, labels = found(points, triangles)
    shut = np.array(points)
    for number in (2, 3):  # lids that meet halfway
        middle = points[np.abs(labels) == number, 1].mean()
        upper, lower = labels == number, labels == -number
        shut[upper, 1] = np.minimum(shut[upper, 1], middle)
        shut[lower, 1] = np.maximum(shut[lower, 1], middle)
    anchors, _ = found(shut, triangles)
    assert not np.isin(labels[anchors.corners[:, 0]], (2, -2, 3, -3)).any()
