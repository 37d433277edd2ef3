"""Differences along edges: the signed incidence matrix, edge weights, and Laplacians made of them.

An edge (i, j) has the vector ``x_j - x_i``; its row of the incidence matrix M holds -1 at i and +1 at j, so that
``M x`` are the edge vectors, and ``M^T W M`` is the Laplacian with edge weights W.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import distinct_edges

SMALLEST_COTANGENT = 0.05  # obtuse and flat triangles: weights stay positive, so that a face keeps one solution
LARGEST_COTANGENT = 20.0
_FLATTEST_TANGENT = 1e-15  # tangent of the smallest angle that is not 0


def incidence(edges: IntArray, point_count: int) -> Any:
    """(e, n) sparse signed incidence matrix of (e, 2) edges."""
    from scipy.sparse import csr_array

    rows = np.repeat(np.arange(len(edges)), 2)
    signs = np.tile([-1.0, 1.0], len(edges))
    return csr_array((signs, (rows, np.asarray(edges).ravel())), shape=(len(edges), point_count))


def edge_vectors(points: FloatArray, edges: IntArray) -> FloatArray:
    """(..., e, 3) vectors from the first to the second end of (e, 2) edges, of points (..., n, 3)."""
    return np.asarray(points[..., edges[:, 1], :] - points[..., edges[:, 0], :])


def cotangent_weights(points: FloatArray, triangles: IntArray) -> tuple[IntArray, FloatArray]:
    """Edges (e, 2) of the triangles, lower point first, and their weights (e,): half the sum of the cotangents of the
    angles opposite (Pinkall & Polthier 1993), kept between `SMALLEST_COTANGENT` and `LARGEST_COTANGENT`.
    """
    corners = points[triangles]
    pairs, cotangents = [], []
    for apex in range(3):
        a, b = corners[:, (apex + 1) % 3] - corners[:, apex], corners[:, (apex + 2) % 3] - corners[:, apex]
        doubled_area = np.linalg.norm(np.cross(a, b), axis=1)
        along = (a * b).sum(axis=1)
        least = np.maximum(
            _FLATTEST_TANGENT * np.abs(along), np.finfo(np.float64).tiny
        )  # a sum of cotangents stays finite
        cotangents.append(0.5 * along / np.maximum(doubled_area, least))
        pairs.append(triangles[:, [(apex + 1) % 3, (apex + 2) % 3]])
    edges, edge, _ = distinct_edges(np.concatenate(pairs))
    weights = np.bincount(edge, np.concatenate(cotangents), minlength=len(edges))
    return edges, np.clip(weights, SMALLEST_COTANGENT, LARGEST_COTANGENT)
