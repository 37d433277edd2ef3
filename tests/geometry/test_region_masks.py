"""Masks of regions: sums, and the harmonic transition between regions."""

from __future__ import annotations

import numpy as np
import pytest
from faces import grid_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

from facepipe.geometry.polygons import edges
from facepipe.geometry.region_map import normalise_masks, smooth_masks


def _strip(count: int, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A line of points 1 apart, its edges, and the masks of two regions, the first with `first` points."""
    points = np.zeros((count, 3))
    points[:, 0] = np.arange(count)
    left = (np.arange(count) < first).astype(float)
    return points, np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), np.stack([left, 1 - left])


def _grid(size: int, regions: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rumpled grid with normalised masks of seeds scattered over it."""
    rng = np.random.default_rng(seed)
    mesh = grid_mesh(size=size)
    points = mesh.points + rng.normal(scale=0.2, size=mesh.points.shape)
    centres = points[rng.choice(len(points), regions, replace=False)]
    distance = np.linalg.norm(points[None] - centres[:, None], axis=2)
    masks = np.exp(-(distance - distance.min(axis=0)) / rng.uniform(0.05, 1.0))
    return points, edges(mesh.face_vertex_counts, mesh.face_vertex_indices)[0], masks / masks.sum(axis=0)


@settings(deadline=None, max_examples=50)
@given(st.integers(1, 5), st.integers(0, 2**31))
def test_masks_and_rest_sum_to_one(regions: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    masks = rng.random((regions, 40)) * 10.0 ** rng.integers(-6, 6, 40) * (rng.random((regions, 40)) < 0.6)
    normalised, rest = normalise_masks(masks)
    np.testing.assert_allclose(normalised.sum(axis=0) + rest, 1.0, atol=1e-12)
    assert normalised.min() >= 0
    assert (rest[~masks.any(axis=0)] == 1).all()
    below = (masks.sum(axis=0) < 0.999) & masks.any(axis=0)
    np.testing.assert_array_equal(normalised[:, below], masks[:, below])
    above = masks.sum(axis=0) > 1
    np.testing.assert_allclose(normalised[:, above] * masks.sum(axis=0)[above], masks[:, above], rtol=1e-12)
    assert (rest[above] == 0).all()


def test_masks_rounded_to_float32_leave_no_rest() -> None:
    masks = np.random.default_rng(0).dirichlet(np.ones(4), 1000).T.astype(np.float32)
    normalised, rest = normalise_masks(masks)
    assert (rest == 0).all()
    np.testing.assert_allclose(normalised.sum(axis=0), 1.0, atol=1e-15)


def test_without_regions_everything_is_rest() -> None:
    normalised, rest = normalise_masks(np.zeros((0, 3)))
    assert normalised.shape == (0, 3)
    np.testing.assert_array_equal(rest, 1.0)


@pytest.mark.parametrize("width", [1.0, 3.0, 7.0, 9.0])
def test_two_regions_on_a_strip_give_a_ramp_of_the_stated_width(width: float) -> None:
    points, pairs, masks = _strip(30, 15)
    smoothed = smooth_masks(masks, points, pairs, width)
    border = 14.5
    np.testing.assert_allclose(smoothed[1], np.clip((points[:, 0] - border) / width + 0.5, 0, 1), atol=1e-12)


def test_a_ramp_over_edges_of_different_lengths_is_linear_in_length() -> None:
    points, pairs, masks = _strip(30, 15)
    points[:, 0] = np.cumsum(np.random.default_rng(1).uniform(0.2, 2.0, 30))
    smoothed = smooth_masks(masks, points, pairs, 8.0)
    inside = np.flatnonzero((smoothed[1] > 0) & (smoothed[1] < 1))
    band = np.arange(inside[0] - 1, inside[-1] + 2)
    x = points[band, 0]
    np.testing.assert_allclose(smoothed[1, band], (x - x[0]) / (x[-1] - x[0]), atol=1e-12)
    assert x[0] <= (points[14, 0] + points[15, 0]) / 2 - 4 < points[inside[0], 0]
    assert points[inside[-1], 0] < (points[14, 0] + points[15, 0]) / 2 + 4 <= x[-1]


@settings(deadline=None, max_examples=25)
@given(st.integers(2, 5), st.floats(0.5, 6.0), st.integers(0, 2**31))
def test_smoothed_masks_are_shares_and_harmonic_in_a_band(regions: int, width: float, seed: int) -> None:
    points, pairs, masks = _grid(14, regions, seed)
    smoothed = smooth_masks(masks, points, pairs, width)
    assert smoothed.min() >= 0
    assert smoothed.max() <= 1
    np.testing.assert_allclose(smoothed.sum(axis=0), 1.0, atol=1e-12)
    changed = (smoothed != masks).any(axis=0)
    region = masks.argmax(axis=0)
    at_border = np.unique(pairs[region[pairs[:, 0]] != region[pairs[:, 1]]])
    reach = np.linalg.norm(points[changed][:, None] - points[at_border][None], axis=2).min(axis=1, initial=np.inf)
    assert (reach <= width / 2).all()  # paths along edges are no shorter than straight lines
    _assert_between_neighbours(smoothed, changed, points, pairs)


def _assert_between_neighbours(masks: np.ndarray, changed: np.ndarray, points: np.ndarray, pairs: np.ndarray) -> None:
    """Every changed point has the mean of its neighbours, weighted with 1 / length: no extremum inside the band."""
    for point in np.flatnonzero(changed):
        edge = (pairs == point).any(axis=1)
        others = pairs[edge].sum(axis=1) - point
        weights = 1.0 / np.linalg.norm(points[others] - points[point], axis=1)
        np.testing.assert_allclose(masks[:, point], masks[:, others] @ weights / weights.sum(), atol=1e-11)


def test_what_is_away_from_borders_stays_bitwise_and_width_0_changes_nothing() -> None:
    points, pairs, masks = _grid(16, 3, 7)
    np.testing.assert_array_equal(smooth_masks(masks, points, pairs, 0.0), masks)
    smoothed = smooth_masks(masks, points, pairs, 2.0)
    changed = (smoothed != masks).any(axis=0)
    assert changed.any()
    assert not changed.all()
    np.testing.assert_array_equal(smoothed[:, ~changed], masks[:, ~changed])


def test_points_with_nothing_held_around_them_keep_their_masks() -> None:
    points, pairs, masks = _strip(6, 3)
    loose = points + np.array([0.0, 5.0, 0.0])
    both = smooth_masks(
        np.concatenate([masks, masks], axis=1), np.concatenate([points, loose]), np.concatenate([pairs, pairs + 6]), 100
    )
    np.testing.assert_array_equal(both, np.concatenate([masks, masks], axis=1))


def test_points_in_one_place_and_edges_given_twice_do_no_harm() -> None:
    points, pairs, masks = _strip(30, 15)
    points[13] = points[12]
    twice = np.concatenate([pairs, pairs[:, ::-1], [[4, 4]]])
    smoothed = smooth_masks(masks, points, twice, 9.0)
    np.testing.assert_allclose(smoothed.sum(axis=0), 1.0, atol=1e-12)
    np.testing.assert_allclose(smoothed[:, 12], smoothed[:, 13], atol=1e-4)
    np.testing.assert_array_equal(smoothed, smooth_masks(masks, points, pairs, 9.0))
