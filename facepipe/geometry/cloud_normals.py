"""Normals of a cloud of points that has no triangles, all on the outer side.

Source: Hoppe, DeRose, Duchamp, McDonald, Stuetzle, "Surface reconstruction from unorganized points", SIGGRAPH 1992,
sections 3.2 (tangent planes) and 3.3 (orientation along a minimum spanning tree).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError

_POINTS_AT_ONCE = 50_000  # points at once
_LONE_DISTANCE = 6.0  # times the median distance of neighbours: farther off, a point is junk
_LEAST_TURN_COST = 0.05  # of turning neighbours: keeps weights of the tree above 0


class CloudNormals(NamedTuple):
    """Oriented normals of a cloud."""

    normals: FloatArray  # (n, 3) unit length
    spacing: FloatArray  # (n,) mean distance of the neighbours
    lone: BoolArray  # (n,) far from all others


def cloud_normals(points: FloatArray, neighbours: int = 16) -> CloudNormals:
    """Normals by the flattest direction of each point's neighbours, turned alike from point to point, outward.

    Connected pieces are turned so that they bulge outward, each on its own.

    :param points: (n, 3) different points, n over 3
    :param neighbours: points that a tangent plane is fitted to
    :raises InputError: too few points
    """
    from scipy.spatial import cKDTree

    if len(points) < 4:
        raise InputError("cloud", f"{len(points)} points, expected at least 4")
    count = min(neighbours, len(points) - 1)
    distances, near = cKDTree(points).query(points, k=count + 1)
    spacing = distances[:, 1:].mean(axis=1)
    flat = _flattest(points, near)
    normals = _oriented(points, flat, near[:, 1:])
    return CloudNormals(normals, spacing, spacing > _LONE_DISTANCE * np.median(spacing))


def _flattest(points: FloatArray, near: IntArray) -> FloatArray:
    """(n, 3) direction in which the neighbours (n, k) of each point spread least.

    The eigenvector of least eigenvalue of ``sum (p - mean) (p - mean)^T``: the normal of the plane of least squares.
    """
    normals = np.empty((len(points), 3))
    for start in range(0, len(points), _POINTS_AT_ONCE):
        around = points[near[start : start + _POINTS_AT_ONCE]]
        around = around - around.mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        normals[start : start + _POINTS_AT_ONCE] = axes[:, :, 0]
    return normals


def _oriented(points: FloatArray, normals: FloatArray, near: IntArray) -> FloatArray:
    """Signs along the tree over neighbours whose planes turn least, then outward as a whole."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    count = len(points)
    first, second = np.repeat(np.arange(count, dtype=np.int32), near.shape[1]), near.ravel().astype(np.int32)
    first, second = np.minimum(first, second), np.maximum(first, second)
    links = np.sort(first.astype(np.int64) * count + second)
    links = links[np.diff(links, prepend=-1) > 0]
    first, second = (links // count).astype(np.int32), (links % count).astype(np.int32)
    turn = 1.0 + _LEAST_TURN_COST - np.abs(np.einsum("ei,ei->e", normals[first], normals[second]))
    tree = minimum_spanning_tree(coo_array((turn, (first, second)), shape=(count, count)).tocsr()).tocoo()
    _, piece = connected_components(tree, directed=False)
    turned = normals * _signs(tree.row, tree.col, piece, normals)[:, None]
    return np.asarray(turned * _outward(points, turned, piece)[piece, None])


def _signs(first: IntArray, second: IntArray, piece: IntArray, normals: FloatArray) -> FloatArray:
    """(n,) signs along the trees with the edges `one` to `two`, 1 at the first point of each piece."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    count = len(normals)
    roots = np.unique(piece, return_index=True)[1]
    start = np.full(len(roots), count)  # one more point, beside every root
    row, column = np.concatenate([first, start]).astype(np.int32), np.concatenate([second, roots]).astype(np.int32)
    graph = coo_array((np.ones(len(row), np.int8), (row, column)), shape=(count + 1, count + 1)).tocsr()
    order, before = breadth_first_order(graph, count, directed=False)
    order, parents = order[1:], before[order[1:]]
    inner = parents < count
    flips = np.zeros(len(order), bool)
    flips[inner] = np.einsum("ni,ni->n", normals[order[inner]], normals[parents[inner]]) < 0
    signs = [1.0] * (count + 1)
    for point, parent, flip in zip(order.tolist(), parents.tolist(), flips.tolist(), strict=True):
        signs[point] = -signs[parent] if flip else signs[parent]
    return np.array(signs[:count])


def _outward(points: FloatArray, normals: FloatArray, piece: IntArray) -> FloatArray:
    """(p,) 1 for pieces whose normals point away from their middle, -1 for others."""
    counts = np.bincount(piece)
    middle = np.stack([np.bincount(piece, column) for column in points.T], axis=1) / counts[:, None]
    heights = np.bincount(piece, np.einsum("ni,ni->n", normals, points - middle[piece]))
    return np.where(heights < 0, -1.0, 1.0)
