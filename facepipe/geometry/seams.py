"""Seams: border points of meshes that lie on one another, where a surface was cut (for UVs, or into meshes)."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import components


def welded_points(points: FloatArray, border: BoolArray, tolerance: float) -> IntArray:
    """(n,) group of every point (n, 3): border points nearer to each other than `tolerance` are one group.

    Points inside a surface stay apart, wherever they lie: closed lips touch, and are two. Groups are numbered in the
    order of their first points.

    :param border: (n,) whether a point is at an edge that has one face
    """
    from scipy.spatial import cKDTree

    at = np.flatnonzero(border)
    pairs = cKDTree(points[at]).query_pairs(tolerance, output_type="ndarray") if len(at) else np.zeros((0, 2), np.int64)
    groups = components(len(points), at[pairs])
    _, first, place = np.unique(groups, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first, kind="stable"), kind="stable")[place.ravel()])
