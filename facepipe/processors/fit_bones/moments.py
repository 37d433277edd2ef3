"""What a skinned face needs of its points to fit bones: moments, whatever the number of points.

A skinned point ``x_i = sum_d X_d (w_id q_i)`` is linear in the skinning matrices X_d (3 x 4; q_i the homogeneous rest
point). So the weighted squared distance to a target, its gradient and the Gauss-Newton matrix need no sum over points
but the moments ``Q = A^T W A`` and ``T = A^T W t``, where row i of A holds ``w_id q_i``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig import Rig


class SkinnedPoints:
    """The points of a rig as a linear function of its skinning matrices.

    :param rig: m joints, n points
    :param morphed: (n, 3) points before skinning, in bind space; default the neutral's
    """

    def __init__(self, rig: Rig, morphed: FloatArray | None = None) -> None:
        from scipy.sparse import csr_array

        points = rig.points if morphed is None else np.asarray(morphed, dtype=np.float64)
        count = len(rig.joints)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        weights = rig.influences[:, :count].tocsr()
        data = (weights.data[:, None] * homogeneous[np.repeat(np.arange(len(points)), np.diff(weights.indptr))]).ravel()
        columns = (weights.indices[:, None] * 4 + np.arange(4)).ravel()
        self.rows = csr_array((data, columns, weights.indptr * 4), shape=(len(points), 4 * count))  # A
        self.rigid = rig.influences[:, [count]].toarray() * homogeneous  # (n, 4) what hangs at the skeleton itself

    def evaluate(self, matrices: FloatArray, parent_world: FloatArray) -> FloatArray:
        """(n, 3) points of (m, 4, 4) skinning matrices below the parent's world matrix (4, 4)."""
        return np.asarray(self.rows @ stacked(matrices) + self.rigid @ parent_world[:3].T)

    def moments(self, target: FloatArray, weights: FloatArray, parent_world: FloatArray) -> Moments:
        """The moments for targets (n, 3) under point weights (n,)."""
        weighted = self.rows.T.multiply(weights[None]).tocsr()
        goal = target - self.rigid @ parent_world[:3].T
        return Moments((weighted @ self.rows).toarray(), np.asarray(weighted @ goal))

    def retargeted(self, old: Moments, target: FloatArray, weights: FloatArray, parent_world: FloatArray) -> Moments:
        """The moments `old` for another target under the same weights."""
        goal = weights[:, None] * (target - self.rigid @ parent_world[:3].T)
        return Moments(old.pairs, np.asarray(self.rows.T @ goal))


class Moments:
    """``Q`` (4m, 4m) and ``T`` (..., 4m, 3), of one target or many."""

    def __init__(self, pairs: FloatArray, goal: FloatArray) -> None:
        self.pairs, self.goal = pairs, goal

    def applied(self, rows: FloatArray) -> FloatArray:
        """``Q`` times (..., 4m, 3)."""
        many = np.moveaxis(rows, -2, 0)
        return np.moveaxis((self.pairs @ many.reshape(len(many), -1)).reshape(many.shape), 0, -2)

    def gradient(self, matrices: FloatArray) -> FloatArray:
        """(m, 4, 3) derivatives of half the weighted squared distance by (m, 4, 4) skinning matrices' rows."""
        return np.asarray((self.applied(stacked(matrices)) - self.goal).reshape(-1, 4, 3))


def stacked(matrices: FloatArray) -> Any:
    """(..., 4m, 3) of (..., m, 4, 4) skinning matrices: what A is multiplied with."""
    rows = np.swapaxes(matrices[..., :3, :], -1, -2)
    return np.ascontiguousarray(rows).reshape(*matrices.shape[:-3], -1, 3)
