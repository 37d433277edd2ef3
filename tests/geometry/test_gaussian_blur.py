"""Gaussian filters against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from facepipe.geometry.gaussian_blur import gaussian_blur


@pytest.mark.parametrize("shape", [(100, 37), (64, 200), (3, 5), (1, 1)])
@pytest.mark.parametrize("sigmas", [0.7, 2.0, (9.0, 1.6), (0.3, 5.0)])
def test_it_filters_as_scipy_does(shape: tuple[int, int], sigmas: float | tuple[float, float]) -> None:
    """Pictures smaller than the kernel and no multiple of a strip among them."""
    picture = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    given = picture.copy()
    found = gaussian_blur(picture, sigmas)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, gaussian_filter(picture.astype(np.float64), sigmas), atol=2e-6)
    np.testing.assert_array_equal(picture, given)
