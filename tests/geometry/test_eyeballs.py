"""Eyeballs: balls fitted to points, and surfaces by their radius in every direction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import shared
from scipy.spatial.transform import Rotation
from solids import ball

from facepipe.core.errors import FitError
from facepipe.geometry.balls import RadialSurface, fit_ball
from facepipe.geometry.polygons import components, edges, point_areas, point_triangles


def _cornea(directions: np.ndarray) -> np.ndarray:
    """Radius of an eyeball of 12 with a cornea that stands out by 2.4 within 30 degrees of +Z."""
    ahead = np.maximum(directions[:, 2] - np.cos(np.radians(30)), 0.0) / (1 - np.cos(np.radians(30)))
    return np.asarray(12.0 * (1 + 0.2 * ahead))


@settings(deadline=None, max_examples=50)
@given(st.integers(4, 60), st.floats(-2, 2), st.integers(0, 2**31))
def test_points_of_a_ball_give_it_back(count: int, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = np.concatenate(
        [[[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.6, -0.6, -0.53]], rng.normal(size=(count - 4, 3))]
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centre, radius = rng.normal(size=3) * 5, 10.0**size
    found = fit_ball(centre + radius * directions)
    np.testing.assert_allclose(found.centre, centre, atol=1e-9 * (radius + 5))
    assert found.radius == pytest.approx(radius, rel=1e-9)
    assert found.rms <= 1e-9 * (radius + 5)


def test_a_bulging_cornea_hardly_moves_the_ball() -> None:
    points, triangles = ball(24)
    bulged = points * _cornea(points)[:, None]
    found = fit_ball(bulged, point_areas(bulged, triangles))
    assert found.radius == pytest.approx(12.0, rel=1e-6)
    np.testing.assert_allclose(found.centre, 0.0, atol=1e-5)
    assert found.rms > 0.1  # the bulge still counts in the RMS


def test_points_without_a_ball_are_refused() -> None:
    flat = np.random.default_rng(0).normal(size=(20, 3)) * (1, 1, 0)
    for points in (flat, flat[:3], np.full((5, 3), 2.0), np.full((5, 3), np.nan)):
        with pytest.raises(FitError, match="ball"):
            fit_ball(points)


def test_the_nearer_direction_counts_by_the_inverse_square_of_its_angle() -> None:
    near, far = np.radians([10.0, 20.0])
    surface = np.array([[np.cos(near), np.sin(near), 0.0], [2 * np.cos(far), 0.0, 2 * np.sin(far)]])
    radius = (1.0 / np.sin(near / 2) ** 2 + 2.0 / np.sin(far / 2) ** 2) / (np.sin([near / 2, far / 2]) ** -2.0).sum()
    depth = RadialSurface(surface, np.zeros(3)).depths(np.array([[0.5, 0.0, 0.0]]))
    assert depth == pytest.approx(radius - 0.5)


@pytest.mark.parametrize("rings", [4, 9, 20])
def test_depth_in_a_ball_is_radius_less_distance_however_coarse(rings: int) -> None:
    surface, _ = ball(rings, 2.0)
    points = np.random.default_rng(rings).uniform(-3, 3, (500, 3))
    depths = RadialSurface(surface + 5.0, np.full(3, 5.0)).depths(points + 5.0)
    np.testing.assert_allclose(depths, np.maximum(2.0 - np.linalg.norm(points, axis=1), 0.0), atol=1e-12)
    assert RadialSurface(surface, np.zeros(3)).depths(np.zeros((1, 3))) == pytest.approx([2.0])


def test_half_a_ball_goes_on_as_a_ball() -> None:
    surface, _ = ball(12, 2.0)
    half = surface[surface[:, 2] >= 0]
    points = np.random.default_rng(0).uniform(-2, 2, (200, 3))
    expected = np.maximum(2.0 - np.linalg.norm(points, axis=1), 0.0)
    np.testing.assert_allclose(RadialSurface(half, np.zeros(3)).depths(points), expected, atol=1e-12)


def test_depth_in_a_cornea_is_along_the_ray() -> None:
    surface, _ = ball(48)
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = rng.uniform(8, 16, 2000)
    eye = RadialSurface(surface * _cornea(surface)[:, None], np.zeros(3))
    error = eye.depths(directions * distances[:, None]) - np.maximum(_cornea(directions) - distances, 0.0)
    assert np.abs(error).max() < 0.3  # half the way between neighbours, on the steepest part
    assert np.sqrt((error**2).mean()) < 0.03
    own = eye.depths(surface * (_cornea(surface) - 1.0)[:, None])
    np.testing.assert_allclose(own, 1.0, atol=1e-6)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31))
def test_depths_move_with_the_surface_and_grow_with_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface, points = rng.normal(size=(30, 3)), rng.normal(size=(40, 3)) * 0.7
    turn, scale, shift = Rotation.random(random_state=seed % 1000).as_matrix(), rng.uniform(0.1, 9), rng.normal(size=3)
    depths = RadialSurface(surface, np.zeros(3)).depths(points)
    moved = RadialSurface(scale * surface @ turn.T + shift, shift).depths(scale * points @ turn.T + shift)
    np.testing.assert_allclose(moved, scale * depths, atol=1e-9 * scale)


def test_real_eyeballs() -> None:
    """The white of an ICT eye lies within 0.25 mm RMS of the ball, whose cornea stands out by more than 1 mm."""
    from facepipe.importers import ict

    parts = ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts
    eye = next(mesh for mesh in parts.meshes if mesh.name == "EyeballLeft")
    shell = components(len(eye.points), edges(eye.face_vertex_counts, eye.face_vertex_indices)[0]) == 0
    triangles = point_triangles(eye.face_vertex_counts, eye.face_vertex_indices)
    points = np.asarray(eye.points, np.float64)
    found = fit_ball(points[shell], point_areas(points, triangles)[shell])
    offsets = points[shell] - found.centre
    off_mm = 10 * (np.linalg.norm(offsets, axis=1) - found.radius)
    white = offsets[:, 2] < found.radius * np.cos(np.radians(60))
    assert np.sqrt((off_mm[white] ** 2).mean()) < 0.25
    assert off_mm[~white].max() > 1.0
    back = fit_ball(points[shell][offsets[:, 2] < 0])
    assert np.linalg.norm(found.centre - back.centre) * 10 < 0.6
