"""The unknowns of a bone fit: the coefficients that may move, each once where some move alike."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.processors.fit_bones.symmetry import Symmetry


class Variables:
    """v unknowns for the coefficients of m joints, with their limits.

    :param lower: (m, 9)
    :param upper: (m, 9)
    :param free: (m,) joints that may move
    :param levers: (9,) how far a channel moves points, about: 1 of translations, a length of angles and scales
    :param symmetry: ties coefficients to others, whose limits are mirror images
    """

    def __init__(
        self, lower: FloatArray, upper: FloatArray, free: BoolArray, levers: FloatArray, symmetry: Symmetry | None
    ) -> None:
        moving = np.flatnonzero((free[:, None] & (lower < upper)).ravel())
        self.shape = lower.shape
        self.joints: IntArray = np.unique(moving // 9)  # (f,) those with an unknown
        self._flat = moving  # (c,) coefficients that move
        leaders = moving if symmetry is None else symmetry.leaders[moving]
        leading, self._variable = np.unique(leaders, return_inverse=True)  # (v,), (c,)
        self._sign = np.ones(len(moving)) if symmetry is None else symmetry.signs[moving]
        self._tied = symmetry is not None
        self.lower, self.upper = lower.ravel()[leading], upper.ravel()[leading]  # (v,)
        self._squares = levers[leading % 9] ** 2  # (v,)
        self._inside = (np.searchsorted(self.joints, moving // 9) * 9) + moving % 9  # (c,) among those of `joints`

    def __len__(self) -> int:
        return len(self.lower)

    def reduced(self, coefficients: FloatArray) -> FloatArray:
        """(v,) the unknowns of (m, 9) coefficients: means of what is tied, inside the limits."""
        count = np.maximum(np.bincount(self._variable, minlength=len(self)), 1)
        return np.clip(self.gradient(coefficients) / count, self.lower, self.upper)

    def expanded(self, x: FloatArray, others: FloatArray) -> FloatArray:
        """(..., m, 9) coefficients of (..., v) unknowns; those that don't move as in (m, 9)."""
        full = np.broadcast_to(others.ravel(), (*x.shape[:-1], others.size)).copy()
        full[..., self._flat] = x[..., self._variable] * self._sign
        return full.reshape(*x.shape[:-1], *self.shape)

    def gradient(self, by_coefficient: FloatArray) -> FloatArray:
        """(..., v) derivatives by the unknowns, of those by coefficients (..., m, 9)."""
        moving = by_coefficient.reshape(*by_coefficient.shape[:-2], -1)[..., self._flat] * self._sign
        if not self._tied:
            return moving
        summed = np.zeros((*moving.shape[:-1], len(self)))
        np.add.at(np.moveaxis(summed, -1, 0), self._variable, np.moveaxis(moving, -1, 0))
        return summed

    def floored(self, diagonal: FloatArray, share: float) -> FloatArray:
        """(v,) of a matrix's diagonal, each element at least a share of the largest, whatever the units are."""
        largest = max(float((diagonal / self._squares).max(initial=0.0)), float(np.finfo(np.float64).tiny))
        return np.asarray(np.maximum(diagonal, share * largest * self._squares))

    def matrix(self, by_coefficient: FloatArray) -> FloatArray:
        """(v, v) of a symmetric matrix (9 f, 9 f) over the coefficients of `joints`."""
        if len(self._inside) < len(by_coefficient):
            by_coefficient = by_coefficient[np.ix_(self._inside, self._inside)]
        if not self._tied:
            return by_coefficient
        from scipy.sparse import csr_array

        ties = csr_array((self._sign, (np.arange(len(self._sign)), self._variable)), (len(self._sign), len(self)))
        return np.asarray(ties.T @ (ties.T @ by_coefficient).T)
