"""Joints that are who somebody is: learnt places and weights, which change a face at rest and pose nothing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.rig.bone_coefficients import coefficient_matrices, rest_coefficients

LEVER = 16.0  # millimetres: a radian or a factor counts as that far, about what it moves a joint's points


@dataclass(frozen=True, kw_only=True)
class IdentityJoints:
    """``p <- p + sum_j w_j (M_j - 1) (r - c_j)`` with the mean face's point r, so that readers add what is constant.

    M_j is that of bone coefficients (`facepipe.rig.bone_coefficients`) along the axes of the basis.
    """

    rows: IntArray  # (n,) points of the basis that have weights
    points: FloatArray  # (n, 3) r of these, millimetres
    places: FloatArray  # (j, 3) c, millimetres
    indices: IntArray  # (n, k) joints of each point
    weights: FloatArray  # (n, k), in sum 1

    def offsets(self, coefficients: FloatArray) -> FloatArray:
        """(n, 3) how points move by the (j, 9) coefficients of the first joints; others are at rest."""
        whole = rest_coefficients(len(self.places))
        whole[: len(coefficients)] = coefficients
        linear = coefficient_matrices(whole)[:, :3, :3] - np.eye(3)
        constant = whole[:, :3] - np.einsum("jab,jb->ja", linear, self.places)
        # rows of a joint: what each coordinate of its points adds, and what it adds to all
        moves = np.concatenate([linear.transpose(0, 2, 1), constant[:, None]], axis=1)
        return np.asarray(self._shares @ moves.reshape(-1, 3))

    @cached_property
    def _shares(self) -> Any:
        """Sparse (n, 4 j): weights times points, and weights."""
        from scipy.sparse import csr_array

        count, k = self.indices.shape
        own = self.weights[..., None] * np.append(self.points, np.ones((count, 1)), axis=1)[:, None]
        columns = 4 * self.indices[..., None] + np.arange(4)
        ends = np.arange(0, 4 * k * count + 1, 4 * k)
        return csr_array((own.ravel(), columns.ravel(), ends), (count, 4 * len(self.places)))

    @cached_property
    def ways(self) -> Any:
        """Sparse (3 n, 9 j), how points go by each coefficient at rest, angles and scales in millimetres of `LEVER`."""
        return joint_ways(self.points, self.places, self.indices, self.weights)


def coefficients_of_steps(steps: FloatArray | IntArray, size: float) -> FloatArray:
    """(j, 9) bone coefficients of whole steps of a size in millimetres."""
    units = np.repeat([1.0, 1.0 / LEVER], [3, 6])
    return np.asarray(rest_coefficients(len(steps)) + np.asarray(steps, np.float64) * size * units)


def joint_ways(points: FloatArray, places: FloatArray, indices: IntArray, weights: FloatArray) -> Any:
    """Sparse (3 n, 9 j) derivatives at rest of `IdentityJoints.offsets`, angles and scales by `LEVER`."""
    from scipy.sparse import csr_array

    arms = (points[:, None] - places[indices]) / LEVER
    own = np.zeros((*indices.shape, 3, 9))
    for axis in range(3):
        ahead, behind = (axis + 1) % 3, (axis + 2) % 3
        own[..., axis, axis] = 1.0
        own[..., ahead, 3 + axis] = -arms[..., behind]
        own[..., behind, 3 + axis] = arms[..., ahead]
        own[..., axis, 6 + axis] = arms[..., axis]
    own *= weights[..., None, None]
    rows = 3 * np.arange(len(points))[:, None, None, None] + np.arange(3)[:, None]
    columns = 9 * indices[:, :, None, None] + np.arange(9)
    rows, columns = (np.broadcast_to(numbers, own.shape) for numbers in (rows, columns))
    some = own != 0
    return csr_array((own[some], (rows[some], columns[some])), (3 * len(points), 9 * len(places)))
