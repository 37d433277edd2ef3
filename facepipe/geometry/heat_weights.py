"""Weights that spread over a surface like heat, and their restriction to few influences.

Each point is drawn towards the shares that own it (the joints nearest along the surface) by a strength that falls
with the square of its distance, and the weights between are in thermal equilibrium:

    (L + H A) w = H A p,    H = sharpness / distance^2

with the cotangent Laplacian L and areas A. All edge weights are positive, so the matrix is an M-matrix: weights lie in
0..1 by the maximum principle, and sum to 1 since the shares do and L has constants as its kernel.

Source: Baran & Popovic, "Automatic rigging and animation of 3D characters", SIGGRAPH 2007, section 4 (there with
distances through the volume). Bounded biharmonic weights (Jacobson et al. 2011) are smoother at the joints, but cost a
quadratic program a joint over all points instead of one factorisation for all joints.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.factor import factorise
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.polygons import point_areas

SMALLEST_SHARE = 1e-3  # weights below are left out: they cost an influence and move nothing
_COLUMNS_AT_ONCE = 64  # right hand sides at a time: a bound on memory


def heat_weights(
    points: FloatArray, triangles: IntArray, shares: FloatArray, distances: FloatArray, sharpness: float = 1.0
) -> FloatArray:
    """(n, k) weights in 0..1 of the shares (n, k) spread over the surface, in sum what these sum to.

    :param points: (n, 3)
    :param triangles: (t, 3), at every point one at least, or that point keeps its shares
    :param shares: (n, k) 0 or more
    :param distances: (n,) above 0, in the unit of the points: where it is small a point keeps its shares
    :param sharpness: above 0; larger ones keep more of the shares
    """
    from scipy.sparse import diags_array

    edges, weights = cotangent_weights(points, triangles)
    M = incidence(edges, len(points))
    strength = sharpness * point_areas(points, triangles) / np.maximum(distances, np.finfo(np.float64).tiny) ** 2
    # a point without a triangle has a row of zeros, by which no factor exists: held, it keeps its shares
    isolated = strength <= 0
    strength[isolated] = max(float(strength.max(initial=0.0)), 1.0)
    scale = 1.0 / np.median(strength) if len(strength) else 1.0
    factor = factorise((M.T @ diags_array(weights) @ M + diags_array(strength)) * scale)
    right = strength[:, None] * scale * np.asarray(shares, np.float64)
    parts = [factor.solve(right[:, at : at + _COLUMNS_AT_ONCE]) for at in range(0, right.shape[1], _COLUMNS_AT_ONCE)]
    return np.asarray(np.maximum(np.concatenate(parts, axis=1), 0.0) if parts else right)


def fewest(weights: FloatArray, count: int) -> FloatArray:
    """(n, k) the `count` largest weights of each row, in sum 1; others 0.

    The largest of those left out is taken off the others first, so that no weight jumps where two change places: from
    point to point weights stay as smooth as they were, unless more than `count` are about equal.
    """
    weights = np.asarray(weights, np.float64)
    if weights.shape[1] > count:
        ordered = -np.sort(-weights, axis=1)
        over = ordered[:, count, None]
        kept = np.maximum(weights - over, 0.0)
        equal = kept.sum(axis=1) <= SMALLEST_SHARE * weights.sum(axis=1)  # all that is left would be noise
        if equal.any():
            rank = np.argsort(np.argsort(-weights[equal], axis=1, kind="stable"), axis=1, kind="stable")
            kept[equal] = np.where(rank < count, weights[equal], 0.0)
        weights = kept
    return normalised(np.where(weights < SMALLEST_SHARE * weights.sum(axis=1, keepdims=True), 0.0, weights))


def normalised(weights: FloatArray) -> FloatArray:
    """Rows of `weights` (n, k) in sum 1; rows that are all 0 stay so."""
    total = weights.sum(axis=1, keepdims=True)
    return np.asarray(weights / np.where(total > 0, total, 1.0))


def influences(weights: FloatArray, count: int) -> tuple[IntArray, FloatArray]:
    """Indices (n, count) int32 and weights (n, count) float32 of rows with at most `count` weights, largest first.

    Without weight: index 0.
    """
    width = min(count, weights.shape[1])
    order = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    kept = np.take_along_axis(weights, order, axis=1)
    kept = normalised(kept).astype(np.float32)
    return np.where(kept > 0, order, 0).astype(np.int32), kept
