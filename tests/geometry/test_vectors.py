"""Rows of vectors, by hand."""

from __future__ import annotations

import numpy as np

from facepipe.geometry.vectors import to_segment


def test_distances_from_a_segment_are_those_from_its_side_or_its_nearer_end() -> None:
    points = np.array([[2.0, 1, 0], [4, 3, 4], [-2, 1, 0], [13, 5, 0], [1, 1, 0]])
    start, end = np.array([1.0, 1, 0]), np.array([9.0, 1, 0])
    np.testing.assert_allclose(to_segment(points, start, end), [0, np.sqrt(20.0), 3, np.sqrt(32.0), 0], atol=1e-12)
    np.testing.assert_allclose(to_segment(points, start, start)[:3], [1, np.sqrt(29.0), 3], atol=1e-12)
