"""Triangles count as turned over where they are seen."""

import numpy as np

from facepipe.geometry.polygons import flipped_triangles
from facepipe.scanning.transfer.finish import seen_triangles

_SHEET = np.array([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]])
_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_MARKS = np.zeros((68, 3))


def _two_sheets(z: float, away: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A sheet, and a wider one at depth `z`, moved aside by `away`."""
    return np.concatenate([_SHEET, 2.0 * _SHEET + (away, 0.0, z)]), np.concatenate([_FACES, _FACES + 4])


def test_what_lies_behind_is_not_seen_from_before() -> None:
    points, triangles = _two_sheets(-0.1)
    points[4:] *= (0.4, 0.4, 1.0)
    np.testing.assert_array_equal(seen_triangles(points, triangles, _MARKS), _FACES)


def test_a_body_is_not_looked_at() -> None:
    points, triangles = _two_sheets(0.0, 400.0)
    np.testing.assert_array_equal(seen_triangles(points, triangles, _MARKS), _FACES)


def test_a_sheet_seen_from_the_side_alone_counts() -> None:
    """It hangs behind another's back from the front, and beside it from between front and side."""
    points, triangles = _two_sheets(-30.0)
    points[4:] *= (0.4, 0.4, 1.0)
    assert len(seen_triangles(points, triangles, _MARKS)) == 4


def test_a_mesh_without_triangles_has_none() -> None:
    assert len(seen_triangles(np.zeros((3, 3)), np.zeros((0, 3), np.int64), _MARKS)) == 0


def test_triangles_that_turn_over_are_counted_on_what_is_seen() -> None:
    points, triangles = _two_sheets(-0.1)
    points[4:] *= (0.4, 0.4, 1.0)
    moved = points.copy()
    moved[2], moved[6] = (-40.0, -40.0, 0.0), (-40.0, -40.0, -0.1)  # one of each sheet
    seen = seen_triangles(points, triangles, _MARKS)
    assert flipped_triangles(points, moved, seen).sum() == flipped_triangles(_SHEET, moved[:4], _FACES).sum() > 0
