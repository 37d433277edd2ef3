"""The same space of shapes, by shapes that are local: most of their offsets are next to nothing."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_MOST = 1500  # points that the rotation is found by
_ROUNDS = 100
_STILL = 1e-6  # of the criterion, a round


def local_basis(shapes: FloatArray) -> FloatArray:
    """(r, n, 3) orthonormal shapes of the same space as orthonormal `shapes`, in fewer places where there are such.

    Turned so that what moves a point is one shape rather than all: varimax (Kaiser, "The varimax criterion for analytic
    rotation in factor analysis", 1958), by singular values (Magnus and Neudecker's fixed point).
    """
    count = len(shapes)
    if count < 2:
        return shapes
    moves = np.square(shapes).sum(axis=(0, 2))
    chosen = np.sort(np.argsort(-moves, kind="stable")[: 4 * _MOST])
    rows = shapes[:, chosen[:: max(1, len(chosen) // _MOST)]].reshape(count, -1).T
    rotation, least = np.eye(count), 0.0
    for _ in range(_ROUNDS):
        turned = rows @ rotation
        left, sizes, right = np.linalg.svd(rows.T @ (turned**3 - turned * np.mean(turned**2, axis=0)))
        rotation = left @ right
        if sizes.sum() <= least * (1.0 + _STILL):
            break
        least = sizes.sum()
    local = np.tensordot(rotation.T, shapes, axes=1)
    return np.asarray(local if _spread(local) < _spread(shapes) else shapes)


def _spread(shapes: FloatArray) -> float:
    """How far the shapes reach: for one squared length, longer sums are of more places."""
    return float(np.linalg.norm(shapes, axis=2).sum())
