"""A sealed mouth, cut along its lips."""

from __future__ import annotations

import numpy as np
import plain_heads
import pytest

from facepipe.core.errors import FitError
from facepipe.geometry.polygons import small_holes
from facepipe.scanning.transfer.cut import cut_mouth
from facepipe.scanning.transfer.finish import mouth_is_sealed


def test_a_cut_opens_the_mouth_and_changes_nothing_else() -> None:
    points, triangles = plain_heads.skin(holes=False)
    marks = plain_heads.landmarks()
    assert mouth_is_sealed(points, triangles, marks)
    cut = cut_mouth(points, np.full(len(triangles), 3), triangles.ravel(), marks)
    opened, faces = points[cut.source], cut.indices.reshape(-1, 3)
    assert not mouth_is_sealed(opened, faces, marks)
    assert np.array_equal(cut.source[: len(points)], np.arange(len(points)))
    assert np.array_equal(opened[faces], points[triangles])  # every corner is where it was
    loop = [hole for hole in small_holes(opened, faces, 60.0) if len(hole) == 2 * len(cut.line) - 2]
    assert len(loop) == 1
    assert set(cut.source[loop[0]]) == set(cut.line)
    assert np.allclose(points[cut.line[[0, -1]], :2], [[-22.0, -30.0], [22.0, -30.0]], atol=1.0)
    assert np.abs(points[cut.line, 1] + 30.0).max() < 2.0


def test_lips_part_above_and_below() -> None:
    points, triangles = plain_heads.skin(holes=False)
    cut = cut_mouth(points, np.full(len(triangles), 3), triangles.ravel(), plain_heads.landmarks())
    faces = cut.indices.reshape(-1, 3)
    new = faces[(faces >= len(points)).any(axis=1)]
    own = faces[np.isin(faces, cut.line[1:-1]).any(axis=1)]
    assert points[cut.source[new]][..., 1].mean() < points[own][..., 1].mean() - 0.5


def test_a_line_that_parts_nothing_is_refused() -> None:
    points, triangles = plain_heads.skin(holes=False)
    away = plain_heads.landmarks() + np.array([0.0, 0.0, 500.0])
    with pytest.raises(FitError, match="cut-mouth"):
        cut_mouth(points, np.full(len(triangles), 3), triangles.ravel(), away)
