"""Triangles that a change of points has turned over."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

# Twice the area, relative to the square of the longest side, below which the normal is float32 rounding.
_FLAT = 1e-6


def flipped_triangles(before: FloatArray, after: FloatArray, triangles: IntArray) -> BoolArray:
    """(t,) which of `triangles` (t, 3) turn by more than 90 degrees from points `before` (n, 3) to `after` (n, 3).

    Those without area before or after are not counted.
    """
    return turned_triangles(triangle_normals(before, triangles), after, triangles)


def turned_triangles(normals: FloatArray, points: FloatArray, triangles: IntArray) -> BoolArray:
    """(t,) which of `triangles` (t, 3) at `points` (n, 3) face away from the reference `normals` (t, 3).

    The length of the reference normals is of no matter; those of length 0, and triangles without area, are not counted.
    """
    return np.asarray(np.einsum("ti,ti->t", np.asarray(normals, np.float64), triangle_normals(points, triangles)) < 0)


def triangle_normals(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3) unit normals; 0 where a triangle has no area."""
    corners = np.asarray(points, np.float64)[triangles]
    sides = corners[:, [1, 2, 0]] - corners
    normals = np.cross(sides[:, 0], sides[:, 1])
    lengths = np.linalg.norm(normals, axis=1)
    longest = np.einsum("tei,tei->te", sides, sides).max(axis=1, initial=0.0)
    solid = lengths > _FLAT * longest
    normals[~solid] = 0.0
    return np.asarray(normals / np.where(solid, lengths, 1.0)[:, None])
