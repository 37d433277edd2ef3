"""Winding numbers against surfaces whose inside is known, and against the sum of all solid angles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from facepipe.geometry.winding_numbers import WindingNumbers


def numbers(surface: Any, places: np.ndarray) -> np.ndarray:
    return WindingNumbers(np.asarray(surface.vertices), np.asarray(surface.faces)).at(places)


def test_of_a_ball_and_a_ring_they_are_1_inside_and_0_outside() -> None:
    places = np.random.default_rng(1).uniform(-1.6, 1.6, (300, 3))
    ball: Any = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    away = np.linalg.norm(places, axis=1)
    clear = np.abs(away - 1.0) > 0.02
    np.testing.assert_allclose(numbers(ball, places)[clear], (away < 1.0)[clear], atol=0.01)
    ring: Any = trimesh.creation.torus(major_radius=1.0, minor_radius=0.4)
    tube = np.hypot(np.hypot(places[:, 0], places[:, 1]) - 1.0, places[:, 2])
    clear = np.abs(tube - 0.4) > 0.03
    np.testing.assert_allclose(numbers(ring, places)[clear], (tube < 0.4)[clear], atol=0.01)


def test_where_a_surface_laps_over_itself_they_are_2_and_of_an_open_one_the_share_it_covers() -> None:
    box: Any = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide().subdivide()
    other = box.copy().apply_translation((1.0, 0.0, 0.0))
    lapped = trimesh.util.concatenate([box, other])
    np.testing.assert_allclose(numbers(lapped, np.array([[0.5, 0.1, 0.2], [-0.5, 0.1, 0.2]])), [2.0, 1.0], atol=0.01)
    half = box.copy()
    half.update_faces(half.triangles_center[:, 2] > -0.99)  # five of six sides, seen from the middle
    assert numbers(half, np.zeros((1, 3)))[0] == pytest.approx(5 / 6, abs=0.01)


def test_far_triangles_as_dipoles_change_little() -> None:
    rough: Any = trimesh.creation.icosphere(subdivisions=4, radius=100.0)
    random = np.random.default_rng(2)
    points = np.asarray(rough.vertices) * random.uniform(0.9, 1.1, (len(rough.vertices), 1))
    places = random.uniform(-70.0, 70.0, (50, 3))
    corners = points[np.asarray(rough.faces)][None] - places[:, None, None]
    a, b, c = (corners[:, :, corner] for corner in range(3))
    la, lb, lc = (np.linalg.norm(corner, axis=2) for corner in (a, b, c))
    products = (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    volume = (a * np.cross(b, c)).sum(axis=2)
    exact = (2.0 * np.arctan2(volume, la * lb * lc + products)).sum(axis=1) / (4.0 * np.pi)
    np.testing.assert_allclose(WindingNumbers(points, np.asarray(rough.faces)).at(places), exact, atol=0.01)
