"""Nested dissection: the points of a surface in halves of halves, with few points between any two halves.

Eliminated from the smallest parts up, a sparse system on the surface fills in little, and what fills in lies in dense
blocks. Source: A. George, Nested dissection of a regular finite element mesh (1973); least separators between two given
sides are vertex covers of the links across (Koenig's theorem).
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

_CUTS = (0.4, 0.5, 0.6)  # shares of a part's points on the lower side that are tried
_AXES = 2  # of a part's principal axes, the longest ones, that are tried


def dissect(places: FloatArray, links: IntArray, most: int) -> IntArray:
    """(n,) part of each point in a binary tree: part p lies between 2p and 2p + 1, and 1 is the root.

    Linked points are of one part, or one's part lies above the other's.

    :param places: (n, 3) about where the points are: parts are cut across their longest axes
    :param links: (p, 2) pairs of points
    :param most: points of a part that is not cut
    """
    part = np.ones(len(places), np.int64)
    active = np.ones(len(places), bool)
    while True:
        _, group, counts = np.unique(np.where(active, part, 0), return_inverse=True, return_counts=True)
        active &= (counts > most)[group]
        if not active.any():
            return part
        links = links[active[links].all(axis=1) & (part[links[:, 0]] == part[links[:, 1]])]
        upper = _cut(places, links, np.where(active, group, -1), counts)
        across = links[upper[links[:, 0]] != upper[links[:, 1]]]
        turned = upper[across[:, 0]]
        between = _cover(np.where(turned[:, None], across[:, ::-1], across))
        part[active] = 2 * part[active] + upper[active]
        part[between] //= 2
        active[between] = False


def _cut(places: FloatArray, links: IntArray, group: IntArray, counts: IntArray) -> BoolArray:
    """(n,) points of the upper side of their group; the cut of each that seems to need the smallest separator."""
    rows = np.flatnonzero(group >= 0)
    own, count = group[rows], len(counts)
    along = principal(places[rows], own, counts)
    first = np.concatenate([[0], np.cumsum(np.bincount(own, minlength=count))[:-1]])
    upper, least = np.zeros(len(group), bool), np.full(count, np.inf)
    for axis in range(_AXES):
        order = np.lexsort((along[:, axis], own))
        rank = np.empty(len(rows), np.int64)
        rank[order] = np.arange(len(rows)) - first[own[order]]
        for cut in _CUTS:
            side = np.zeros(len(group), bool)
            side[rows] = rank >= np.clip(cut * counts[own], 1, counts[own] - 1)  # neither is empty
            touched = np.zeros(len(group), bool)
            touched[links[side[links[:, 0]] != side[links[:, 1]]]] = True
            cost = np.bincount(group[touched], minlength=count) / np.sqrt(cut * (1.0 - cut))
            better = cost < least
            least[better] = cost[better]
            upper[rows] = np.where(better[own], side[rows], upper[rows])
    return upper


def principal(places: FloatArray, group: IntArray, counts: IntArray) -> FloatArray:
    """(m, 3) coordinates of points along the principal axes of their group, the longest first."""
    count = len(counts)
    middle = np.stack([np.bincount(group, axis, minlength=count) for axis in places.T], axis=1) / counts[:, None]
    offsets = places - middle[group]
    products = [np.bincount(group, a * b, minlength=count) for a in offsets.T for b in offsets.T]
    axes = np.linalg.eigh(np.stack(products, axis=1).reshape(count, 3, 3))[1]
    return np.asarray(np.einsum("mi,mij->mj", offsets, axes[group])[:, ::-1])


def _cover(pairs: IntArray) -> IntArray:
    """The fewest points that leave none of the pairs (p, 2) whole, each pair with its first one on one side."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    if not len(pairs):
        return np.zeros(0, np.int64)
    (left, first), (right, second) = (np.unique(column, return_inverse=True) for column in pairs.T)
    ends = first.astype(np.int32), second.astype(np.int32)  # what scipy before 1.15 matches
    graph = csr_array((np.ones(len(pairs), np.int8), ends), shape=(len(left), len(right)))
    mate = np.asarray(maximum_bipartite_matching(graph, perm_type="column"))  # (left,) in right, -1 where there is none
    back = np.full(len(right), -1)
    back[mate[mate >= 0]] = np.flatnonzero(mate >= 0)
    from_free, reached = mate < 0, np.zeros(len(right), bool)  # along alternating paths from unmatched ones
    while True:
        more = np.zeros(len(right), bool)
        more[second[from_free[first]]] = True
        more &= ~reached
        if not more.any():
            return np.concatenate([left[~from_free], right[reached]])
        reached |= more
        from_free[back[more]] = True
