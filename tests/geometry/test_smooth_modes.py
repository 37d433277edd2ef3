"""Smooth deformations as modes: their covariance is the kernel's, in each axis by itself."""

from __future__ import annotations

import numpy as np

from facepipe.geometry.smooth_modes import smooth_modes


def test_covariance_is_that_of_the_kernel() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-50.0, 50.0, (300, 3))
    modes = smooth_modes(points, 60.0, 2.0, 60)
    covariance = np.einsum("kni,kmj->nmij", modes, modes)
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    kernel = 4.0 * np.exp(-squares / (2.0 * 60.0**2))
    for axis in range(3):
        assert np.abs(covariance[:, :, axis, axis] - kernel).max() < 0.1
    assert np.abs(covariance[:, :, 0, 1]).max() == 0.0


def test_places_follow_no_order_and_more_than_there_are_do_no_harm() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-50.0, 50.0, (30, 3))
    order = rng.permutation(30)
    whole, mixed = smooth_modes(points, 40.0, 1.0, 100), smooth_modes(points[order], 40.0, 1.0, 100)
    np.testing.assert_allclose(
        np.einsum("kni,kmi->nm", mixed, mixed), np.einsum("kni,kmi->nm", whole, whole)[np.ix_(order, order)], atol=1e-6
    )
    assert len(whole) % 3 == 0
    assert len(whole) <= 90
