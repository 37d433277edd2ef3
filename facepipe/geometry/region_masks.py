"""Soft masks of regions: made to sum to 1, and smoothed across the borders between regions."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.factor import factorise
from facepipe.geometry.polygons import components, distinct_edges

_SUM_ROUNDING = 1e-5  # sums of masks closer to 1 than this were 1 before they were stored
_SHORTEST_EDGE = 1e-6  # of the mean edge: shorter edges count as this long


def normalise_masks(masks: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The masks (R, n) of R regions so that none sums above 1, and the rest (n,) of points that sum below 1.

    Masks, each 0 or more, and rest sum to 1: the rest is the share of a point that belongs to no region.
    """
    masks = np.asarray(masks, np.float64)
    largest = np.maximum(masks.max(axis=0, initial=0.0), 1.0)
    sums = (masks / largest).sum(axis=0) * largest
    rest = np.where(sums < 1.0 - _SUM_ROUNDING, 1.0 - sums, 0.0)
    normalised = masks / largest / np.where(rest > 0, 1.0, np.where(sums > 0, sums / largest, 1.0))
    return normalised, rest


def smooth_masks(masks: FloatArray, points: FloatArray, edges: IntArray, width: float) -> FloatArray:
    """Masks (R, n) with a harmonic transition of `width` (units of `points`) across the borders between regions.

    A border crosses every edge whose end points have different largest regions. Points nearer to one than half the
    width, along the edges (e, 2), take the solution of the discrete Laplace equation ``sum_j (m_i - m_j) / l_ij = 0``
    over edges of length l; all others keep their masks exactly. The weights are above 0, so that the maximum principle
    holds: smoothed masks lie between those around the band, and sum to 1 where those do. Free points that no edges join
    to a point outside the band keep their masks.

    :param width: 0 or more; 0 changes nothing
    """
    smoothed = np.array(masks, dtype=np.float64)
    pairs, *_ = distinct_edges(np.asarray(edges).reshape(-1, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    if width == 0 or not len(pairs) or not len(smoothed):
        return smoothed
    lengths = np.linalg.norm(np.asarray(points, np.float64)[pairs[:, 0]] - np.asarray(points)[pairs[:, 1]], axis=1)
    lengths = np.maximum(lengths, max(_SHORTEST_EDGE * float(lengths.mean()), np.finfo(np.float64).tiny))
    # a piece without a held point has the constants as the kernel of its Laplacian: no factor
    free = _joined(_border_distances(smoothed, pairs, lengths) < width / 2, pairs)
    if free.any():
        _relax(smoothed, free, pairs, 1.0 / lengths)
    return smoothed


def _border_distances(masks: FloatArray, pairs: IntArray, lengths: FloatArray) -> FloatArray:
    """(n,) distance along the edges to the nearest border, which crosses an edge where two regions are equal."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    count = masks.shape[1]
    with_rest = np.concatenate([masks, 1.0 - masks.sum(axis=0, keepdims=True)])
    region = with_rest.argmax(axis=0)
    crossing = region[pairs[:, 0]] != region[pairs[:, 1]]
    start, end = pairs[crossing].T
    lead = with_rest[region[start], start] - with_rest[region[end], start]
    lag = with_rest[region[end], end] - with_rest[region[start], end]
    share = lead / np.where(lead + lag > 0, lead + lag, 1.0)
    seeds = np.full(count, np.inf)
    np.minimum.at(seeds, start, share * lengths[crossing])
    np.minimum.at(seeds, end, (1.0 - share) * lengths[crossing])
    seeded = np.flatnonzero(np.isfinite(seeds))
    tiny = np.finfo(np.float64).tiny  # csgraph takes a length of 0 for no edge
    rows = np.concatenate([pairs[:, 0], np.full(len(seeded), count)]).astype(np.int32)
    columns = np.concatenate([pairs[:, 1], seeded]).astype(np.int32)
    values = np.concatenate([lengths, np.maximum(seeds[seeded], tiny)])
    graph = coo_array((values, (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    return np.asarray(dijkstra(graph, directed=False, indices=count))[:count]


def _joined(free: BoolArray, pairs: IntArray) -> BoolArray:
    """The free points (n,) of components that also have points that are not free."""
    component = components(len(free), pairs)
    held = np.zeros(int(component.max()) + 1, dtype=np.bool_)
    held[component[~free]] = True
    return np.asarray(free & held[component])


def _relax(masks: FloatArray, free: BoolArray, pairs: IntArray, weights: FloatArray) -> None:
    """Solve the Laplace equation at the `free` points for all masks, in place."""
    from scipy.sparse import coo_array, diags_array

    count = len(free)
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    adjacency = coo_array((np.tile(weights, 2), (rows, columns)), shape=(count, count)).tocsr()[free]
    laplacian = diags_array(adjacency.sum(axis=1)) - adjacency[:, free]
    held = adjacency[:, ~free] @ masks[:, ~free].T
    masks[:, free] = np.clip(factorise(laplacian).solve(np.ascontiguousarray(held)).T, 0.0, 1.0)
