"""Nearest places on surfaces: exact, whatever the triangles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from solids import ball

from facepipe.core.errors import InputError
from facepipe.geometry.closest_points import CORNER, EDGE, INSIDE, closest_places, place_shares


def _one_by_one(points: np.ndarray, surface: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m, t) distance of every point from every triangle: of the projections on its plane, lines and corners, those
    that lie on it."""
    best = np.full((len(points), len(triangles)), np.inf)
    for number, corners in enumerate(surface[triangles]):
        for spots in ((0, 1, 2), (0, 1), (1, 2), (2, 0), (0,), (1,), (2,)):
            span = (corners[list(spots[1:])] - corners[spots[0]]).T
            solved = np.linalg.lstsq(span, (points - corners[spots[0]]).T, rcond=None)[0] if span.size else 0.0
            place = corners[spots[0]] + (span @ solved).T if span.size else np.tile(corners[spots[0]], (len(points), 1))
            shares = np.atleast_2d(solved) if span.size else np.zeros((1, len(points)))
            within = (shares >= -1e-12).all(axis=0) & (shares.sum(axis=0) <= 1 + 1e-12)
            distance = np.where(within, np.linalg.norm(points - place, axis=1), np.inf)
            best[:, number] = np.minimum(best[:, number], distance)
    return best


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 40), st.integers(0, 2**31))
def test_distances_are_those_of_trying_every_triangle(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface = rng.normal(size=(count + 2, 3)) * 10.0 ** rng.uniform(-3, 2, (count + 2, 1))  # large ones and small ones
    triangles = rng.integers(0, count + 2, (count, 3))  # some are segments, some are points
    points = np.concatenate([rng.normal(size=(20, 3)) * 10.0 ** rng.uniform(-3, 2, (20, 1)), surface[:3]])
    found = closest_places(points, surface, triangles)
    scale = np.abs(surface).max()
    np.testing.assert_allclose(found.distances, _one_by_one(points, surface, triangles).min(axis=1), atol=1e-9 * scale)
    np.testing.assert_allclose(np.linalg.norm(points - found.places, axis=1), found.distances, atol=1e-9 * scale)


def test_one_large_triangle_among_many_small_ones_is_found() -> None:
    points, triangles = ball(20)
    surface = np.concatenate([points, [[-1e4, -1e4, 1.5], [1e4, -1e4, 1.5], [0, 2e4, 1.5]]])
    triangles = np.concatenate([triangles, [[len(points), len(points) + 1, len(points) + 2]]])
    found = closest_places(np.array([[0.3, 0.2, 1.4], [50, 60, 2.0]]), surface, triangles)
    assert found.distances == pytest.approx([0.1, 0.5])


def test_distances_from_a_ball_are_distance_less_radius() -> None:
    surface, triangles = ball(60, 2.0)
    points = np.random.default_rng(1).uniform(-3, 3, (1000, 3))
    found = closest_places(points + 5.0, surface + 5.0, triangles).distances
    error = found - np.abs(2.0 - np.linalg.norm(points, axis=1))
    sagitta = 2.0 * (1 - np.cos(np.pi / 120 * np.sqrt(2)))  # how far the flat triangles lie inside the sphere
    assert np.abs(error).max() < 1.01 * sagitta


def test_places_lie_on_the_part_of_the_triangle_that_is_named() -> None:
    surface = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = np.array(
        [[-1.0, -1, 2], [2, -0.5, 0], [-0.2, 3, 1], [0.5, -1, 0], [1, 1, 1], [-1, 0.5, 0], [0.2, 0.3, -4]]
    )
    found = closest_places(points, surface, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(found.features, [CORNER, CORNER + 1, CORNER + 2, EDGE, EDGE + 1, EDGE + 2, INSIDE])
    np.testing.assert_allclose(
        found.places, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0], [0.2, 0.3, 0]]
    )


def test_a_corner_is_named_as_one_from_either_of_its_edges() -> None:
    """Rounding decides which of two edges ends nearer to a point beyond their corner."""
    surface = np.array([[-0.5, -0.4, 0.6], [-0.8, 0.2, 0.5], [-0.6, -0.9, -0.5]])
    outwards = surface - np.roll(surface, -1, axis=0) / 2.0 - np.roll(surface, -2, axis=0) / 2.0
    points = surface[:, None] + np.linspace(0.01, 1.0, 50)[:, None] * outwards[:, None]
    found = closest_places(points.reshape(-1, 3), surface, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(found.features, CORNER + np.repeat([0, 1, 2], 50))


def test_shares_of_the_corners_make_the_place() -> None:
    surface, triangles = ball(5)
    surface = surface * [1.0, 2.0, 0.5] + [7.0, -3.0, 1.0]
    points = np.concatenate([np.random.default_rng(2).normal(size=(300, 3)) * 3 + surface.mean(axis=0), surface])
    found = closest_places(points, surface, triangles)
    shares = place_shares(found, surface, triangles)
    np.testing.assert_allclose(np.einsum("mc,mci->mi", shares, surface[triangles[found.triangles]]), found.places)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert shares.min() >= 0
    on = found.features < INSIDE
    assert 0 < on.sum() < len(on)
    np.testing.assert_array_equal((shares[on] == 0).sum(axis=1), np.where(found.features[on] < EDGE, 2, 1))


def test_points_of_the_surface_lie_at_distance_0() -> None:
    surface, triangles = ball(6)
    surface = surface * np.random.default_rng(3).uniform(0.25, 1.75, (len(surface), 1))
    middles = surface[triangles].mean(axis=1)
    found = closest_places(np.concatenate([surface, middles]), surface, triangles)
    np.testing.assert_allclose(found.distances, 0, atol=1e-15)


def test_a_surface_without_triangles_or_with_wrong_ones_is_refused() -> None:
    points = np.zeros((2, 3))
    for triangles in (np.zeros((0, 3), int), np.array([[0, 1, 2]]), np.array([[-1, 0, 1]])):
        with pytest.raises(InputError, match="triangles"):
            closest_places(points, points, triangles)
    assert closest_places(np.zeros((0, 3)), *ball(4)).distances.shape == (0,)
