"""Visibility from outside: points of a surface that nothing hides from some side."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import point_normals

_DIRECTIONS = 60
_TRIANGLE_SAMPLES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1 / 3, 1 / 3, 1 / 3]])  # of a triangle
_CELLS_ACROSS = 100  # across the surface: wider than the gaps between samples
_DEPTH_SLACK = 0.012  # of the surface's size, in depth
_FACING_COSINE = 0.1  # cosine between a point's normal and the direction that it is seen from


def seen_from_outside(points: FloatArray, triangles: IntArray) -> BoolArray:
    """(n,) points that some of 60 directions all around sees from the front, with every triangle opaque.

    Depth maps of samples of the triangles, so that gaps much thinner than the surface (lips, lids) are closed.

    :param points: (n, 3)
    :param triangles: (t, 3), oriented outward
    """
    normals = point_normals(points, triangles)
    samples = np.einsum("sc,tci->tsi", _TRIANGLE_SAMPLES, points[triangles]).reshape(-1, 3)
    size = float(np.ptp(samples, axis=0).max()) or 1.0
    seen = np.zeros(len(points), bool)
    # (count, 3) directions spread evenly (a Fibonacci spiral)
    step = np.arange(_DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * step / _DIRECTIONS
    turn = np.pi * (1.0 + np.sqrt(5.0)) * step
    width = np.sqrt(1.0 - height**2)
    for towards in np.stack([width * np.cos(turn), height, width * np.sin(turn)], axis=1):
        facing = np.flatnonzero((normals @ towards > _FACING_COSINE) & ~seen)
        if len(facing):
            seen[facing] = _in_front(points[facing], samples, towards, size)
    used = np.zeros(len(points), bool)
    used[triangles.ravel()] = True
    return seen & used


def _in_front(points: FloatArray, samples: FloatArray, towards: FloatArray, size: float) -> BoolArray:
    """(m,) points with nothing before them."""
    across = np.eye(3)[np.abs(towards).argmin()]
    right = np.cross(across, towards)
    axes = np.stack([right, np.cross(towards, right)], axis=1) / np.linalg.norm(right)
    flat = samples @ axes
    low = flat.min(axis=0)
    cell = size / _CELLS_ACROSS
    shape = np.floor((flat.max(axis=0) - low) / cell).astype(np.int64) + 1

    def cells(values: FloatArray) -> IntArray:
        row, column = np.clip(np.floor((values - low) / cell).astype(np.int64), 0, shape - 1).T
        return np.asarray(row * shape[1] + column)

    nearest = np.full(int(shape.prod()), -np.inf)
    np.maximum.at(nearest, cells(flat), samples @ towards)
    return np.asarray(points @ towards >= nearest[cells(points @ axes)] - _DEPTH_SLACK * size)
