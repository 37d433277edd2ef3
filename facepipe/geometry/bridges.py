"""Bridge edges: what joins the loose parts of a face, and its joints, to the part that holds the anchor.

Real heads have dozens of connected components (eyeballs, every tooth, lashes). Edge vectors alone say nothing about
where a loose component lies, so each of its points gets an edge to the nearest point of the main component, and each
joint edges to the points around it. Their vectors are blended like those of any edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

JOINT_REACH = 1.5  # a joint's bridges go to the points up to this many times as far as the nearest one
JOINT_BRIDGES = 256  # at most, the nearest ones
TIES = 8  # points looked at for being equally near
_EQUAL = 1e-9  # distances that differ by less are equal


@dataclass(frozen=True)
class Bridges:
    """Edges from followers to leaders, and their weights: followers move with leaders, never the other way."""

    followers: IntArray  # (b,)
    leaders: IntArray  # (b,) points
    weights: FloatArray  # (b,) above 0


def part_bridges(points: FloatArray, component: IntArray, main: int) -> Bridges:
    """From every point (of `points` (n, 3)) outside component number `main` to the nearest point in it.

    The weight is ``1 / (1 + (d / median)^2)``, by the median distance of the same component: where a part touches the
    face it follows the face.
    """
    from scipy.spatial import cKDTree

    inside = np.flatnonzero(component == main)
    loose = np.flatnonzero(component != main)
    if not len(loose):
        return Bridges(loose, loose, np.zeros(0))
    distances, nearest = cKDTree(points[inside]).query(points[loose], k=np.arange(1, min(TIES, len(inside)) + 1))
    distance = distances[:, 0]
    # the first of those that are equally near, which rounding (other units, axes or places) would choose among
    tied = distances <= distance[:, None] * (1.0 + _EQUAL)
    leaders = np.where(tied, inside[nearest], len(points)).min(axis=1)
    reach = _medians(distance, component[loose])
    return Bridges(loose, leaders, 1.0 / (1.0 + (distance / reach) ** 2))


def joint_bridges(points: FloatArray, joints: FloatArray) -> Bridges:
    """From every joint (j, 3) to the points around it; the joints' numbers are the followers."""
    from scipy.spatial import cKDTree

    count = min(JOINT_BRIDGES, len(points))
    if not count or not len(joints):
        return Bridges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    distances, nearest = cKDTree(points).query(joints, k=np.arange(1, count + 1))
    reach = JOINT_REACH * np.maximum(distances[:, :1], np.finfo(np.float64).tiny)
    near = distances <= reach * (1.0 + _EQUAL)
    followers = np.repeat(np.arange(len(joints)), near.sum(axis=1))
    weights = 1.0 / (1.0 + np.divide(distances, reach, out=np.zeros_like(distances), where=near) ** 2)
    return Bridges(followers, nearest[near], weights[near])


def _medians(values: FloatArray, group: IntArray) -> FloatArray:
    """(n,) median of each value's group; 1 where that is 0."""
    numbers, place, counts = np.unique(group, return_inverse=True, return_counts=True)
    order = np.lexsort((values, place))
    ends = np.cumsum(counts)
    medians = values[order][ends - counts + counts // 2] if len(numbers) else np.zeros(0)
    return np.asarray(np.where(medians > 0, medians, 1.0)[place])
