"""Edge weights against their formula."""

from __future__ import annotations

import numpy as np
import pytest

from facepipe.geometry.gradient_system import LARGEST_COTANGENT, SMALLEST_COTANGENT, cotangent_weights

_ROOT = np.sqrt(3.0)


@pytest.mark.parametrize("size", [1.0, 1e-9, 1e6])
def test_cotangents_are_those_of_the_angles_whatever_the_size(size: float) -> None:
    """Angles of 30, 60 and 90 degrees at points 0, 1 and 2."""
    points = size * np.array([[0.0, 0, 0], [2.0, 0, 0], [1.5, _ROOT / 2.0, 0]])
    edges, weights = cotangent_weights(points, np.array([[0, 1, 2]]))
    assert edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    np.testing.assert_allclose(weights, [SMALLEST_COTANGENT, 0.5 / _ROOT, 0.5 * _ROOT], rtol=1e-6)


def test_triangles_without_area_have_the_weights_at_the_bounds() -> None:
    edges, weights = cotangent_weights(np.array([[0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0]]), np.array([[0, 1, 2]]))
    assert edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert weights.tolist() == [SMALLEST_COTANGENT, LARGEST_COTANGENT, LARGEST_COTANGENT]
