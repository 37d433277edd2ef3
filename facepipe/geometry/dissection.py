"""Cholesky factors of matrices of one pattern over a surface, made again and again with other values.

Nested dissection (George, "Nested Dissection of a Regular Finite Element Mesh", SIAM J. Numer. Anal. 1973) cuts the
surface in halves, and these in halves; the points along a cut come after both sides of it. What is eliminated together
is a dense front (Duff and Reid, "The Multifrontal Solution of Indefinite Sparse Symmetric Linear Equations", ACM TOMS
1983), so that nearly all work is products of dense matrices. The order is found once for all factors.

A step of registration on the head in the box (42,186 unknowns, 109 right-hand sides, one thread) takes 0.35 s, where
CHOLMOD, which finds its order anew and solves all sides to the end, takes 0.65 s (`factor`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

_LEAF = 64  # points that are not cut in halves; a factor takes 5 % more time with 16, and with 96
_COLUMNS = 96  # of what is left of a front at a time, of each those below the diagonal


@dataclass(frozen=True, kw_only=True)
class _Front:
    """What is eliminated together, in places of the order."""

    own: slice  # points that it eliminates
    points: IntArray  # (p,) those, and the later ones that they or earlier ones of their side go with, ascending
    children: tuple[int, ...]  # fronts before, whose rest goes into this one
    within: tuple[IntArray, ...]  # of each child: the rows (3r,) of this front that its rest goes to
    taken: IntArray  # (v,) values of the pattern that enter here
    put: IntArray  # (v, 2) rows and columns, as points of the front


class Dissection:
    """An order of elimination of n points, of which each has three unknowns.

    :param pattern: (n, n) sparse and symmetric: which points go together
    :param places: (n, 3) where they are, for halves that lie apart
    """

    def __init__(self, pattern: Any, places: FloatArray) -> None:
        pattern = pattern.tocsr()
        pattern.sort_indices()
        count = len(places)
        self._keys = np.repeat(np.arange(count), np.diff(pattern.indptr)) * count + pattern.indices
        groups = _halved(pattern, places)
        self.order = np.concatenate([own for own, _ in groups]) if groups else np.zeros(0, np.int64)
        place = np.empty(count, np.int64)
        place[self.order] = np.arange(count)
        self._fronts: list[_Front] = []
        start = 0
        for own, children in groups:
            stop = start + len(own)
            taken = _spans(pattern.indptr[own], pattern.indptr[own + 1])
            column = np.repeat(np.arange(start, stop), pattern.indptr[own + 1] - pattern.indptr[own])
            row = place[pattern.indices[taken]]
            kept = row >= start
            taken, column, row = taken[kept], column[kept], row[kept]
            rests = [self._fronts[child] for child in children]
            later = [row, np.arange(start, stop)]
            later += [rest.points[rest.own.stop - rest.own.start :] for rest in rests]
            points = np.unique(np.concatenate(later))
            self._fronts.append(
                _Front(
                    own=slice(start, stop),
                    points=points,
                    children=children,
                    within=tuple(
                        _axes(np.searchsorted(points, rest.points[rest.own.stop - rest.own.start :])) for rest in rests
                    ),
                    taken=taken,
                    put=np.stack([np.searchsorted(points, row), column - start], axis=1),
                )
            )
            start = stop

    def factor(self, shared: Any, blocks: FloatArray) -> FrontalFactor:
        """The factor of ``kron(S, 1) + diag(B_1 .. B_n)``, axes of a point side by side.

        :param shared: (n, n) sparse S of the pattern, or less
        :param blocks: (n, 3, 3) B
        :raises numpy.linalg.LinAlgError: the matrix is not positive definite
        """
        from scipy.linalg.blas import dsyrk, dtrsm

        shared, count = shared.tocsr(), len(blocks)
        rows = np.repeat(np.arange(count), np.diff(shared.indptr))
        values = np.zeros(len(self._keys))
        values[np.searchsorted(self._keys, rows * count + shared.indices)] = shared.data
        rests: list[FloatArray] = []  # of fronts that are not in a later one yet, of which the lower halves count
        lower, below = [], []
        for front in self._fronts:
            own, size = 3 * (front.own.stop - front.own.start), 3 * len(front.points)
            panel, rest = np.zeros((size, own)), np.zeros((size - own, size - own))
            for axis in range(3):
                panel[3 * front.put[:, 0] + axis, 3 * front.put[:, 1] + axis] = values[front.taken]
            diagonal = np.arange(own // 3)
            panel[:own].reshape(-1, 3, own // 3, 3)[diagonal, :, diagonal] += blocks[self.order[front.own]]
            for within, more in zip(front.within, rests[len(rests) - len(front.within) :], strict=True):
                here = int(np.searchsorted(within, own))
                later = within[here:] - own
                panel[within[:, None], within[:here]] += more[:, :here]
                for first in range(0, len(later), _COLUMNS):
                    columns = slice(first, first + _COLUMNS)
                    rest[later[first:, None], later[columns]] += more[here + first :, here:][:, columns]
            del rests[len(rests) - len(front.within) :]
            lower.append(np.linalg.cholesky(panel[:own]))
            below.append(dtrsm(1.0, lower[-1].T, panel[own:].T, trans_a=1))
            rests.append(dsyrk(-1.0, below[-1], 1.0, rest.T, trans=1, overwrite_c=1).T if len(rest) else rest)
        return FrontalFactor(order=_axes(self.order), fronts=tuple(self._fronts), lower=lower, below=below)


@dataclass(frozen=True, kw_only=True)
class FrontalFactor:
    """``A = P^T L L^T P``, L in fronts."""

    order: IntArray  # (3n,)
    fronts: tuple[_Front, ...]
    lower: Sequence[FloatArray]  # of each front (3o, 3o), on its own points
    below: Sequence[FloatArray]  # (3o, 3r) transposed, on the later ones

    def solve(self, right: FloatArray) -> FloatArray:
        """The x of A x = `right` (3n, m)."""
        return self.backward(self.forward(right))

    def forward(self, right: FloatArray) -> FloatArray:
        """``L^-1 P right`` of (3n, m): its products with itself are those of `right` with ``A^-1 right``."""
        from scipy.linalg.blas import dtrsm

        found = np.asarray(right, np.float64)[self.order]
        for front, lower, below in zip(self.fronts, self.lower, self.below, strict=True):
            own = slice(3 * front.own.start, 3 * front.own.stop)
            found[own] = dtrsm(1.0, lower.T, found[own].T, side=1).T
            found[_axes(front.points[front.own.stop - front.own.start :])] -= below.T @ found[own]
        return found

    def backward(self, halfway: FloatArray) -> FloatArray:
        """The x of ``L^T P x = halfway`` (3n, m)."""
        from scipy.linalg.blas import dtrsm

        found = np.array(halfway, np.float64)
        for front, lower, below in zip(self.fronts[::-1], self.lower[::-1], self.below[::-1], strict=True):
            own = slice(3 * front.own.start, 3 * front.own.stop)
            rest = found[own] - below @ found[_axes(front.points[front.own.stop - front.own.start :])]
            found[own] = dtrsm(1.0, lower.T, rest.T, side=1, trans_a=1).T
        solution = np.empty_like(found)
        solution[self.order] = found
        return solution


def _halved(pattern: Any, places: FloatArray) -> list[tuple[IntArray, tuple[int, ...]]]:
    """Points of each front, and the fronts before it that go into it; a front comes after those."""
    found: list[tuple[IntArray, tuple[int, ...]]] = []
    side = np.zeros(len(places), np.int8)

    def halve(points: IntArray) -> tuple[int, ...]:
        if len(points) <= _LEAF:
            found.append((points, ()))
            return (len(found) - 1,)
        cuts = (cut(points[np.argsort(column, kind="stable")]) for column in places[points].T)
        near, along, far = min(cuts, key=lambda parts: len(parts[1]))
        before = (*(halve(near) if len(near) else ()), *(halve(far) if len(far) else ()))
        if not len(along):
            return before
        found.append((along, before))
        return (len(found) - 1,)

    def cut(ordered: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        near, far = ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]
        side[near], side[far] = 1, 2
        firsts, seconds = touching(near, 2), touching(far, 1)
        side[ordered] = 0
        if firsts.sum() <= seconds.sum():
            return near[~firsts], near[firsts], far
        return near, far[seconds], far[~seconds]

    def touching(points: IntArray, other: int) -> BoolArray:
        starts, stops = pattern.indptr[points], pattern.indptr[points + 1]
        there = side[pattern.indices[_spans(starts, stops)]] == other
        return np.asarray(np.add.reduceat(there, np.cumsum(stops - starts) - (stops - starts)) > 0)

    if len(places):
        halve(np.arange(len(places)))
    return found


def _spans(starts: IntArray, stops: IntArray) -> IntArray:
    """The numbers from each start up to its stop, one after the other."""
    lengths = stops - starts
    return np.repeat(starts - (np.cumsum(lengths) - lengths), lengths) + np.arange(lengths.sum())


def _axes(points: IntArray) -> IntArray:
    """(3p,) unknowns of points (p,)."""
    return (3 * points[:, None] + np.arange(3)).ravel()
