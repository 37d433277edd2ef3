"""Points at exactly one place as one point."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


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
