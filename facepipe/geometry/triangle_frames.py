"""Frames of triangles with their normals, and gradients of what varies over a triangulated surface.

The frame of a triangle is two of its edges and the scaled normal ``e1 x e2 / sqrt(|e1 x e2|)``, which stands for the
fourth vertex of Sumner & Popović, "Deformation Transfer for Triangle Meshes", SIGGRAPH 2004, section 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

_FLAT = 1e-6  # a triangle lower than this share of its longest edge has no area and no normal


def frames(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3, 3) rows: two edges, and the normal as long as the square root of their cross product."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([b - a, c - a, normal / np.sqrt(np.maximum(length, np.finfo(np.float64).tiny))], axis=1)


def duals(given: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows (t, 3, 3) with ``frame^T dual`` the identity, and areas (t,); both 0 for triangles without area.

    :param given: (t, 3, 3) frames
    """
    first, second, normal = given.transpose(1, 0, 2)
    doubled = (normal * normal).sum(axis=1)  # |n|^2 = |e1 x e2|
    longest = np.maximum.reduce([(side * side).sum(axis=1) for side in (first, second, second - first)])
    flat = doubled <= _FLAT * longest
    doubled = np.where(flat, 1.0, doubled)[:, None]
    upright = normal / np.sqrt(doubled)
    rows = (np.cross(second, upright), np.cross(upright, first), normal)
    found = np.stack([row / doubled for row in rows], axis=1)
    found[flat] = 0.0
    return found, np.where(flat, 0.0, 0.5 * doubled[:, 0])


def hat_gradients(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    """Gradients (t, 3, 3) of the hat functions of each triangle's corners, one a row, and areas (t,)."""
    rows, areas = duals(frames(points, triangles))
    return np.stack([-rows[:, 0] - rows[:, 1], rows[:, 0], rows[:, 1]], axis=1), areas


def gradient_operator(points: FloatArray, triangles: IntArray) -> tuple[Any, FloatArray]:
    """Sparse (2t, n): values at points to their gradients in the planes of the triangles; and areas (t,).

    Rows 2i and 2i + 1 are the slopes of triangle i along its first edge and across it. Triangles without area have
    rows of zeros.
    """
    from scipy.sparse import csr_array

    hats, areas = hat_gradients(points, triangles)
    first, _, normal = frames(points, triangles).transpose(1, 0, 2)
    across = np.cross(normal, first)
    axes = np.stack([first, across], axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    slopes = axes @ hats.transpose(0, 2, 1)  # (t, 2, 3)
    columns = np.repeat(triangles, 2, axis=0).ravel()
    starts = np.arange(0, 6 * len(triangles) + 1, 3)
    return csr_array((slopes.ravel(), columns, starts), shape=(2 * len(triangles), len(points))), areas


def pieces(count: int, triangles: IntArray) -> IntArray:
    """(count,) number of the piece that each point belongs to, connected through triangles."""
    from facepipe.geometry.polygons import components

    return components(count, np.concatenate([triangles[:, :2], triangles[:, 1:]]))
