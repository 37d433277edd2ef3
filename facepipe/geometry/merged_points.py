"""Points that lie on one another as one: at exactly one place, or where a surface was cut (for UVs, or into meshes)."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import components


def merge_points(points: FloatArray) -> tuple[IntArray, IntArray]:
    """First point of every place, in their order, and the place (n,) of every point (n, 3). -0 is 0."""
    values = np.asarray(points, dtype=np.float64) + 0.0
    order = np.lexsort(values.T[::-1])
    ordered = values[order]
    new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])[: len(values)]
    first = order[new]  # the sort is stable: the earliest of equal ones
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    place = np.empty(len(values), np.int64)
    place[order] = rank[np.cumsum(new) - 1]
    return np.sort(first), place


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
