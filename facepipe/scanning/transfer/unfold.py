"""Triangles that a motion turns over, turned back."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import distinct_edges, flipped_triangles

_ROUNDS = 32


def unfolded(points: FloatArray, ended: FloatArray, triangles: IntArray, seen: IntArray, held: BoolArray) -> FloatArray:
    """`ended` with the motion of points of triangles that turn over made that of those around.

    :param points: (n, 3)
    :param triangles: (t, 3) that join them
    :param seen: (k, 3) those of them that may not turn over
    :param held: (n,) points that stay where they ended
    """
    pairs = distinct_edges(np.concatenate([triangles[:, :2], triangles[:, 1:], triangles[:, [2, 0]]]))[0]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    best = delta = ended - points
    fewest = len(seen)
    for turn in range(_ROUNDS):
        flips = flipped_triangles(points, points + delta, seen)
        if flips.sum() < fewest:
            best, fewest = delta, int(flips.sum())
        marked = np.zeros(len(points), bool)
        marked[seen[flips]] = True
        for _ in range(1 + turn // 8):  # farther around where that does not help
            marked[pairs[marked[pairs[:, 0]], 1]] = True
        marked &= ~held
        if not marked.any() or not fewest:
            break
        mine = pairs[marked[pairs[:, 0]]]
        total = np.zeros((len(points), 3))
        np.add.at(total, mine[:, 0], delta[mine[:, 1]])
        around = total[marked] / np.bincount(mine[:, 0], minlength=len(points))[marked, None]
        delta = delta.copy()
        delta[marked] += 0.5 * (around - delta[marked])
        # a triangle that moves as one turns over nowhere
        together = delta[seen[flips]].mean(axis=1, keepdims=True)
        rows = seen[flips].ravel()
        toward = (together - delta[seen[flips]]).reshape(-1, 3)[~held[rows]]
        rows = rows[~held[rows]]
        delta[rows] += 0.5 * toward
    return points + best
