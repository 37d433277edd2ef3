"""Figures of shapes: triangles that turn over where they are seen, and lips that meet or don't."""

import numpy as np
import pytest

from facepipe.geometry.polygons import flipped_triangles
from facepipe.scanning.transfer.figures import lip_figures, seen_triangles

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


def _lips(upper: float, lower: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rims 0.5 mm apart, with a row of points above and below; what moves them along Y."""
    x = np.arange(-20.0, 21.0, 2.0)
    rows = [np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1) for y in (5.0, 0.5, 0.0, -5.0)]
    sides = np.repeat([1, 1, -1, -1], len(x))
    delta = np.zeros((len(sides), 3))
    delta[:, 1] = np.where(sides > 0, upper, lower)
    delta[: len(x), 1] = 30.0  # no rim
    return np.concatenate(rows), sides, delta


@pytest.mark.parametrize(("upper", "lower", "gap"), [(0, 0, 0), (1, -2, 3), (-0.2, 0.1, 0)])
def test_lips_part_at_their_rims(upper: float, lower: float, gap: float) -> None:
    found = lip_figures(*_lips(upper, lower))
    assert found is not None
    assert (found.gap_mean, found.gap_most) == pytest.approx((gap, gap), abs=1e-12)


def test_half_a_mouth_that_opens_has_a_smaller_mean() -> None:
    points, sides, delta = _lips(0.0, 0.0)
    delta[(sides < 0) & (points[:, 0] > 0), 1] = -1.0
    found = lip_figures(points, sides, delta)
    assert found is not None
    assert found.gap_most == pytest.approx(1.0)
    assert found.gap_mean == pytest.approx(10 / 21)


def test_lips_that_are_far_apart_have_no_figures() -> None:
    points, sides, delta = _lips(0.0, 0.0)
    points[sides < 0] -= (0.0, 10.0, 0.0)
    assert lip_figures(points, sides, delta) is None
    assert lip_figures(points, np.zeros_like(sides), delta) is None
