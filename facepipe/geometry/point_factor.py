"""Cholesky factors of systems with three unknowns a point.

``A = kron(S, I) + B``: S holds what acts on all axes alike (a membrane, landmarks), B 3 x 3 blocks that mix them: of a
point (distances along normals), and where it is asked for, of two linked points (changes of triangles). See
`elimination` for the method; the arithmetic runs in dense blocks.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.elimination import Elimination, Front


class PointFactor:
    """L with ``A = L L^T``, unknowns in the order of elimination.

    :param elimination: of the points, with all links that S has
    :param shared: (n, n) sparse symmetric S
    :param blocks: (n, 3, 3) symmetric, B of each point
    :param between: (p, 3, 3) B of each pair of `elimination.links`, rows of the lower point; none where it is 0
    :raises ValueError: S has values between points that are not linked, or the matrix is not positive definite
    """

    def __init__(
        self, elimination: Elimination, shared: Any, blocks: FloatArray, between: FloatArray | None = None
    ) -> None:
        self._elimination = elimination
        self._parts: list[tuple[FloatArray, FloatArray]] = []
        values = _values(elimination, shared, blocks)
        if between is not None:
            _add_between(elimination, between, values)
        complements: dict[int, FloatArray] = {}
        for number, front in enumerate(elimination.fronts):
            own = front.own.stop - front.own.start
            middle = front.start + own * own
            square = values[front.start : middle].reshape((own, own), order="F")
            below = values[middle : middle + front.rows * own].reshape((front.rows, own), order="F")
            self._parts.append(_eliminated(front, square, below, complements, number))

    def solve(self, right: FloatArray) -> FloatArray:
        """The x of A x = `right`, (3n,) or (3n, q), axes of a point side by side."""
        return self.back(self.half(right))

    def half(self, right: FloatArray) -> FloatArray:
        """L^-1 `right` in the order of elimination, so that ``half(a).T @ half(b)`` is ``a.T @ solve(b)``."""
        from scipy.linalg.blas import dtrsm

        order = self._elimination.order
        found = np.asarray(right, np.float64).reshape(len(order), -1)[order].reshape(3 * len(order), -1)
        for front, (square, below) in zip(self._elimination.fronts, self._parts, strict=True):
            own = dtrsm(1.0, square, found[front.own].T, side=1, lower=1, trans_a=1, overwrite_b=1).T
            found[front.own] = own
            if front.rows:
                change = below @ own
                for run, at in front.rim:
                    found[run] -= change[at]
        return found.reshape(right.shape)

    def back(self, halved: FloatArray) -> FloatArray:
        """L^-T `halved`, of what `half` gives."""
        from scipy.linalg.blas import dtrsm

        order = self._elimination.order
        found = np.array(halved, np.float64, order="C").reshape(3 * len(order), -1)
        for front, (square, below) in zip(reversed(self._elimination.fronts), reversed(self._parts), strict=True):
            own = found[front.own]
            if front.rows:
                own = own - below.T @ np.concatenate([found[run] for run, _ in front.rim])
            found[front.own] = dtrsm(1.0, square, own.T, side=1, lower=1).T
        result = np.empty_like(found).reshape(len(order), -1)
        result[order] = found.reshape(len(order), -1)
        return result.reshape(halved.shape)


def _eliminated(
    front: Front, square: FloatArray, below: FloatArray, complements: dict[int, FloatArray], number: int
) -> tuple[FloatArray, FloatArray]:
    """The factor's two blocks of a front; what is left for its rim goes to `complements`, with the sign turned."""
    from scipy.linalg.blas import dsyrk, dtrsm
    from scipy.linalg.lapack import dpotrf

    taken = [(child, complements.pop(child.child)) for child in front.children]
    for child, values in taken:
        for into, out in child.square:
            square[into] -= values[out]
        for into, out in child.below:
            below[into] -= values[out]
    factor, failed = dpotrf(square, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise ValueError("the matrix is not positive definite")
    if front.rows:
        below = dtrsm(1.0, factor, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        rest = dsyrk(1.0, below, lower=1, c=np.zeros((front.rows, front.rows), order="F"), overwrite_c=1)
        for child, values in taken:
            for into, out in child.passed:
                rest[into] += values[out]
        complements[number] = rest
    return factor, below


def _values(elimination: Elimination, shared: Any, blocks: FloatArray) -> FloatArray:
    """The matrix in the blocks of the fronts, on and below the diagonal."""
    count = len(elimination.order)
    entries = shared.tocoo()
    if not (np.isfinite(entries.data).all() and np.isfinite(blocks).all()):
        raise ValueError("the matrix is not positive definite: values that are no number")
    rows, columns = entries.coords if hasattr(entries, "coords") else (entries.row, entries.col)
    upper = rows < columns
    keys = rows[upper].astype(np.int64) * count + columns[upper]
    at = np.searchsorted(elimination.links, keys)
    if len(keys) and (at.max() >= len(elimination.links) or (elimination.links[at] != keys).any()):
        raise ValueError("values between points that are not linked")
    values = np.zeros(elimination.size)
    for axis in range(3):
        values[elimination.slots[at] + axis * (elimination.strides[at] + 1)] = entries.data[upper]
    diagonal = shared.diagonal()
    for column in range(3):
        for row in range(column, 3):
            slots = elimination.own_slots + column * elimination.own_strides + row
            values[slots] = blocks[:, row, column] + (diagonal if row == column else 0.0)
    return values


def _add_between(elimination: Elimination, between: FloatArray, values: FloatArray) -> None:
    """Blocks of linked points added to `values`, where a column is of the point that is eliminated first."""
    if not np.isfinite(between).all():
        raise ValueError("the matrix is not positive definite: values that are no number")
    count = len(elimination.order)
    place = np.empty(count, np.int64)
    place[elimination.order] = np.arange(count)
    low, high = np.divmod(elimination.links, max(count, 1))
    by_column = np.where((place[low] < place[high])[:, None, None], between, between.transpose(0, 2, 1))
    for column in range(3):
        for row in range(3):
            values[elimination.slots + column * elimination.strides + row] += by_column[:, column, row]
