"""Triangles that a change of points turns over."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from facepipe.geometry.polygons import flipped_triangles, triangle_normals, turned_triangles


def test_triangles_that_turn_by_more_than_a_right_angle_are_flipped() -> None:
    rng = np.random.default_rng(4)
    points = rng.normal(size=(60, 3))
    triangles = np.arange(60).reshape(20, 3)
    normals = triangle_normals(points, triangles)
    angles = rng.uniform(0, np.pi, 20)
    after = points.copy()
    for corners, normal, angle in zip(triangles, normals, angles, strict=True):
        axis = np.cross(normal, rng.normal(size=3))  # in the plane: the normal turns by the whole angle
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
        after[corners] = 3.0 * points[corners] @ turn.T + 1.0
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
