"""Distances from surfaces, depth in them, flipped triangles and fitted balls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import shared

from facepipe.errors import FitError, InputError
from facepipe.geometry.balls import fit_ball
from facepipe.geometry.closest_points import closest_places, surface_distances
from facepipe.geometry.flips import flipped_triangles, triangle_normals, turned_triangles
from facepipe.geometry.penetration import penetration
from facepipe.geometry.polygons import components, edges, point_areas, point_triangles

Surface = tuple[np.ndarray, np.ndarray]


def _ball(rings: int = 24, radius: float = 1.0) -> Surface:
    """A closed sphere of triangles between parallels, facing outward."""
    around = 2 * rings
    angles = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(around) / around
    polar, turn = np.meshgrid(*angles, indexing="ij")
    rows = np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0 * turn], axis=2
    ).reshape(-1, 3)
    points = np.concatenate([rows, [[0, 0, 1], [0, 0, -1]]]) * radius
    number = np.arange((rings - 1) * around).reshape(rings - 1, around)
    a, b, c, d = (
        one.ravel() for one in (number[:-1], number[1:], np.roll(number[1:], -1, 1), np.roll(number[:-1], -1, 1))
    )
    top = np.stack([np.full(around, len(rows)), number[0], np.roll(number[0], -1)], axis=1)
    bottom = np.stack([np.full(around, len(rows) + 1), np.roll(number[-1], -1), number[-1]], axis=1)
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1), top, bottom])


def _spiky(seed: int) -> Surface:
    """A closed, star-shaped surface with deep dents and sharp spikes."""
    points, triangles = _ball(6)
    rng = np.random.default_rng(seed)
    return points * rng.uniform(0.25, 1.75, (len(points), 1)), triangles


def _winding(points: np.ndarray, surface: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,) winding numbers (Van Oosterom and Strackee 1983): 1 inside a closed surface, 0 outside."""
    a, b, c = np.moveaxis(surface[triangles][None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(one, axis=2) for one in (a, b, c))
    solid = np.einsum("mti,mti->mt", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("mti,mti->mt", one, other) for one, other in ((a, b), (b, c), (c, a)))
    angles = 2 * np.arctan2(solid, la * lb * lc + ab * lc + bc * la + ca * lb)
    return np.asarray(angles.sum(axis=1) / (4 * np.pi))


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
    points, triangles = _ball(20)
    surface = np.concatenate([points, [[-1e4, -1e4, 1.5], [1e4, -1e4, 1.5], [0, 2e4, 1.5]]])
    triangles = np.concatenate([triangles, [[len(points), len(points) + 1, len(points) + 2]]])
    assert surface_distances(np.array([[0.3, 0.2, 1.4], [50, 60, 2.0]]), surface, triangles) == pytest.approx(
        [0.1, 0.5]
    )


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**31))
def test_depth_has_the_sign_of_the_winding_number(seed: int) -> None:
    surface, triangles = _spiky(seed)
    rng = np.random.default_rng(seed)
    beside = surface[rng.integers(0, len(surface), 200)] + rng.normal(scale=0.05, size=(200, 3))  # corners and edges
    points = np.concatenate([rng.uniform(-2, 2, (100, 3)), beside])
    depth = penetration(points, surface, triangles)
    np.testing.assert_allclose(np.abs(depth), surface_distances(points, surface, triangles))
    clear = np.abs(depth) > 1e-9
    np.testing.assert_array_equal(depth[clear] > 0, _winding(points, surface, triangles)[clear] > 0.5)


def test_depth_in_a_ball_is_radius_less_distance() -> None:
    surface, triangles = _ball(90, 2.0)
    points = np.random.default_rng(1).uniform(-3, 3, (3000, 3))
    depth = penetration(points + 5.0, surface + 5.0, triangles)
    error = depth - (2.0 - np.linalg.norm(points, axis=1))
    sagitta = 2.0 * (1 - np.cos(np.pi / 180 * np.sqrt(2)))  # how far the flat triangles lie inside the sphere
    assert error.max() < 1e-12
    assert error.min() > -1.01 * sagitta


def test_points_of_the_surface_lie_at_depth_0() -> None:
    surface, triangles = _spiky(3)
    middles = surface[triangles].mean(axis=1)
    np.testing.assert_allclose(penetration(np.concatenate([surface, middles]), surface, triangles), 0.0, atol=1e-15)


def test_an_open_surface_has_its_inside_behind_it() -> None:
    surface = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2]])
    depth = penetration(np.array([[0.2, 0.2, -0.5], [0.2, 0.2, 0.5], [-3, -4, -0.1]]), surface, triangles)
    np.testing.assert_allclose(depth, [0.5, -0.5, np.sqrt(25.01)])


def test_a_surface_without_triangles_or_with_wrong_ones_is_refused() -> None:
    points = np.zeros((2, 3))
    for triangles in (np.zeros((0, 3), int), np.array([[0, 1, 2]]), np.array([[-1, 0, 1]])):
        with pytest.raises(InputError, match="triangles"):
            penetration(points, points, triangles)
    assert penetration(np.zeros((0, 3)), *_ball(4)).shape == (0,)


def _turn(axis: Any, angle: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.asarray(axis) / np.linalg.norm(axis) * angle).as_matrix())


def test_triangles_that_turn_by_more_than_a_right_angle_are_flipped() -> None:
    rng = np.random.default_rng(4)
    points = rng.normal(size=(60, 3))
    triangles = np.arange(60).reshape(20, 3)
    normals = triangle_normals(points, triangles)
    angles = rng.uniform(0, np.pi, 20)
    after = points.copy()
    for corners, normal, angle in zip(triangles, normals, angles, strict=True):
        axis = np.cross(normal, rng.normal(size=3))  # in the plane: the normal turns by the whole angle
        after[corners] = 3.0 * points[corners] @ _turn(axis, angle).T + 1.0
    np.testing.assert_array_equal(flipped_triangles(points, after, triangles), angles > np.pi / 2)
    np.testing.assert_array_equal(turned_triangles(7.0 * normals, after, triangles), angles > np.pi / 2)


def test_triangles_without_area_are_not_counted() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    triangles = np.array([[0, 1, 2], [0, 1, 3], [0, 0, 1]])
    mirrored = points * (-1, 1, 1)
    np.testing.assert_array_equal(flipped_triangles(points, mirrored, triangles), [True, False, False])
    rounded = mirrored + np.random.default_rng(0).normal(scale=1e-8, size=points.shape)
    np.testing.assert_array_equal(flipped_triangles(points, rounded, triangles), [True, False, False])
    np.testing.assert_array_equal(flipped_triangles(points, np.zeros((4, 3)), triangles), [False] * 3)


@settings(deadline=None, max_examples=50)
@given(st.integers(4, 60), st.floats(-2, 2), st.integers(0, 2**31))
def test_points_of_a_ball_give_it_back(count: int, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = np.concatenate(
        [[[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.6, -0.6, -0.53]], rng.normal(size=(count - 4, 3))]
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centre, radius = rng.normal(size=3) * 5, 10.0**size
    ball = fit_ball(centre + radius * directions)
    np.testing.assert_allclose(ball.centre, centre, atol=1e-9 * (radius + 5))
    assert ball.radius == pytest.approx(radius, rel=1e-9)
    assert ball.rms <= 1e-9 * (radius + 5)


def test_a_bulging_cornea_hardly_moves_the_ball() -> None:
    points, triangles = _ball(24, 12.0)
    ahead = np.maximum(points[:, 2] / 12.0 - np.cos(np.radians(30)), 0.0) / (1 - np.cos(np.radians(30)))
    bulged = points * (1 + 0.2 * ahead[:, None])  # 2.4 of 12 at the front
    ball = fit_ball(bulged, point_areas(bulged, triangles))
    assert ball.radius == pytest.approx(12.0, rel=1e-6)
    np.testing.assert_allclose(ball.centre, 0.0, atol=1e-5)
    assert ball.rms > 0.1  # the bulge is still told


def test_points_without_a_ball_are_refused() -> None:
    flat = np.random.default_rng(0).normal(size=(20, 3)) * (1, 1, 0)
    for points in (flat, flat[:3], np.full((5, 3), 2.0), np.full((5, 3), np.nan)):
        with pytest.raises(FitError, match="ball"):
            fit_ball(points)
    with pytest.raises(FitError, match="weights"):
        fit_ball(np.random.default_rng(0).normal(size=(5, 3)), -np.ones(5))


def test_real_eyeballs() -> None:
    """The white of an ICT eye lies within 0.25 mm RMS of the ball, whose cornea stands out by more than 1 mm."""
    from facepipe.importers import ict

    parts = ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options()).parts
    eye = next(mesh for mesh in parts.meshes if mesh.name == "EyeballLeft")
    shell = components(len(eye.points), edges(eye.face_vertex_counts, eye.face_vertex_indices)[0]) == 0
    triangles = point_triangles(eye.face_vertex_counts, eye.face_vertex_indices)
    points = np.asarray(eye.points, np.float64)
    ball = fit_ball(points[shell], point_areas(points, triangles)[shell])
    offsets = points[shell] - ball.centre
    off_mm = 10 * (np.linalg.norm(offsets, axis=1) - ball.radius)
    white = offsets[:, 2] < ball.radius * np.cos(np.radians(60))
    assert np.sqrt((off_mm[white] ** 2).mean()) < 0.25
    assert off_mm[~white].max() > 1.0
    back = fit_ball(points[shell][offsets[:, 2] < 0])
    assert np.linalg.norm(ball.centre - back.centre) * 10 < 0.6
