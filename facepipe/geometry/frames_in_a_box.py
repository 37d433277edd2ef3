"""Least squares of many frames in a box, drawn to 0 by their absolute values, and smooth from frame to frame.

``sum_f data_f(x_f) + l1 sum |x| + smooth sum |x_(f-1) - 2 x_f + x_(f+1)|^2``: Levenberg-Marquardt whose steps keep the
signs of x, so that the absolute values are straight along them, and hold what leaves the box.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import solveh_banded

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-7, 1e8
_DAMPING_EASED, _DAMPING_RAISED, _LEAST_RAISED_DAMPING = 0.2, 8.0, 1e-4  # what a failed step raises damping to at least
_SETTLED_FALL = 1e-5  # of the cost: a fall that ends it
_HOLDING_ROUNDS = 6  # of holding what would leave the box
_FLAT_CURVATURE = 1e-10  # of the largest diagonal element


class Data(Protocol):
    """The part of the objective that is each frame's own."""

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        """(k,) of unknowns (k, c) of some frames."""

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k, c) derivatives, and (k, c, c) second ones, positive semidefinite, as far as they are known."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """Limits of unknowns, which have 0 within, and what draws to it."""

    lower: FloatArray  # (c,) 0 or less
    upper: FloatArray  # (c,) 0 or more
    l1: float = 0.0

    def signed(self, x: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Lowest and highest x without a change of sign, and the slope on the way there; 0 where there is no way.

        :param slope: (..., c) without that of the absolute values
        """
        if self.l1 == 0.0:
            low, high = (np.broadcast_to(limit, x.shape) for limit in (self.lower, self.upper))
        else:
            sign = np.sign(x) + (x == 0.0) * ((slope < -self.l1) * 1.0 - (slope > self.l1) * 1.0)
            low = np.where(sign < 0, self.lower, 0.0)
            high = np.where(sign > 0, self.upper, 0.0)
            slope = slope + self.l1 * sign
        held = ((x <= low) & (slope >= 0)) | ((x >= high) & (slope <= 0))
        return low, high, np.where(held, 0.0, slope)


@dataclass(frozen=True, kw_only=True)
class Smoothness:
    """Second differences of frames one after another, some known ones before them."""

    weight: float
    before: FloatArray  # (b, c) at most two

    def cost(self, x: FloatArray) -> float:
        """The smoothness term of unknowns (f, c)."""
        return self.weight * float(np.square(self._bent(np.concatenate([self.before, x]))).sum())

    def slope(self, x: FloatArray) -> FloatArray:
        """(f, c) derivatives of the term at unknowns (f, c)."""
        b, f = len(self.before), len(x)
        bent = self._bent(np.concatenate([self.before, x]))
        whole = np.zeros((b + f, x.shape[1]))
        for offset, factor in enumerate((1.0, -2.0, 1.0)):
            whole[offset : offset + len(bent)] += factor * bent
        return 2.0 * self.weight * whole[b:]

    def diagonals(self, count: int) -> list[FloatArray]:
        """The diagonals of its second derivatives over `count` frames: the main one and two beside it."""
        b = len(self.before)
        differences = np.zeros((max(b + count - 2, 0), b + count))
        for row in range(len(differences)):
            differences[row, row : row + 3] = (1.0, -2.0, 1.0)
        matrix = 2.0 * self.weight * (differences.T @ differences)[b:, b:]
        return [np.diagonal(matrix, offset).copy() for offset in range(min(3, count))]

    @staticmethod
    def _bent(x: FloatArray) -> FloatArray:
        return np.asarray(x[2:] - 2.0 * x[1:-1] + x[:-2] if len(x) > 2 else np.zeros((0, x.shape[1])))


@dataclass(frozen=True, kw_only=True)
class Settled:
    """A minimum near the start."""

    x: FloatArray  # (f, c)
    cost: FloatArray  # (f,) without smoothness
    steps: IntArray  # (f,)


def settle(
    data: Data,
    start: FloatArray,
    box: Box,
    *,
    smoothness: Smoothness | None = None,
    steps: int,
    enough: float,
) -> Settled:
    """A minimum near the start.

    :param start: (f, c)
    :param smoothness: of all frames, one after another; None: each frame is on its own
    :param steps: most of them
    :param enough: the largest change of an unknown in a step that ends it
    """
    state = _State(data, np.clip(start, box.lower, box.upper), box, smoothness)
    for _ in range(steps):
        if not state.active.any():
            break
        state.step(enough)
    return Settled(x=state.x, cost=state.cost, steps=state.steps)


class _State:
    """Frames on their way; those that are on their own are damped on their own."""

    def __init__(self, data: Data, start: FloatArray, box: Box, smoothness: Smoothness | None) -> None:
        count, c = start.shape
        self.data, self.box, self.smoothness = data, box, smoothness
        self.x, self.steps = start, np.zeros(count, np.int64)
        self.active, self.damping = np.ones(count, bool), np.full(count, FIRST_DAMPING)
        self.cost = self._cost(start, np.arange(count))
        self._slope, self._matrix = np.zeros((count, c)), np.zeros((count, c, c))
        self._stale = np.ones(count, bool)

    def step(self, enough: float) -> None:
        """One step of all frames that are not settled."""
        frames = np.flatnonzero(self.active)
        stale = frames[self._stale[frames]]
        if len(stale):
            self._slope[stale], self._matrix[stale] = self.data.normal(self.x[stale], stale)
            self._stale[stale] = False
        x = self.x[frames]
        ahead = x + self._change(frames, x)
        cost = self._cost(ahead, frames)
        total, fall = self.cost[frames], self.cost[frames] - cost
        moved = np.abs(ahead - x).max(axis=1)
        if self.smoothness is not None:
            # a frame's neighbours pay for its step too: it is taken by all frames, or by none
            bent = self.smoothness.cost(x)
            total = np.full(len(frames), total.sum() + bent)
            fall = np.full(len(frames), fall.sum() + bent - self.smoothness.cost(ahead))
            moved[:] = moved.max()
        better = fall > 0.0
        taken = frames[better]
        self.x[taken], self.cost[taken], self._stale[taken] = ahead[better], cost[better], True
        self.steps[frames] += 1
        little = better & (fall < _SETTLED_FALL * total)
        eased, raised = (
            self.damping[frames] * _DAMPING_EASED,
            np.maximum(self.damping[frames] * _DAMPING_RAISED, _LEAST_RAISED_DAMPING),
        )
        self.damping[frames] = np.where(better, np.maximum(eased, LEAST_DAMPING), raised)
        self.active[frames] = (moved > enough) & ~little & (self.damping[frames] < MOST_DAMPING)

    def _cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        return np.asarray(self.data.cost(x, frames) + self.box.l1 * np.abs(x).sum(axis=1))

    def _change(self, frames: IntArray, x: FloatArray) -> FloatArray:
        """(k, c) the damped step within the box: what would leave it is held at its edge, round by round.

        ``(H + damping diag(H) + 2 smooth D^T D) step = -slope`` with second differences D of frames: of the unknowns of
        all frames in a row a band, 2 c beside the diagonal.
        """
        slope, matrix = self._slope[frames], self._matrix[frames].copy()
        smooth = self.smoothness
        diagonals = [] if smooth is None else smooth.diagonals(len(frames))
        if smooth is not None:
            slope += smooth.slope(x)
        low, high, pull = self.box.signed(x, slope)
        size = np.diagonal(matrix, axis1=1, axis2=2)
        # Marquardt's damping follows the curvature of each unknown, whatever its unit; `flat` is for those without any
        flat = _FLAT_CURVATURE * size.max(axis=1, initial=1e-30)[:, None]
        number = np.arange(x.shape[1])
        matrix[:, number, number] += self.damping[frames][:, None] * size + flat
        free = (pull != 0.0) & (low < high)
        change: FloatArray = np.zeros(x.shape)
        for _ in range(_HOLDING_ROUNDS):
            right = pull + _times(matrix, diagonals, change)
            step = _solved(matrix, diagonals, free, -np.where(free, right, 0.0))
            ahead = x + change + step
            out = free & ((ahead < low) | (ahead > high))
            if not out.any():
                return np.asarray(change + step)
            change = np.where(out, np.clip(ahead, low, high) - x, change)
            free = free & ~out
        return np.asarray(np.clip(x + change + np.where(free, step, 0.0), low, high) - x)


def _times(matrix: FloatArray, diagonals: list[FloatArray], x: FloatArray) -> FloatArray:
    """(f, c) of (f, c): each frame's own matrix, and what is between frames."""
    product: FloatArray = np.einsum("fij,fj->fi", matrix, x)
    for offset, values in enumerate(diagonals):
        if offset == 0:
            product += values[:, None] * x
        else:
            product[offset:] += values[:, None] * x[:-offset]
            product[:-offset] += values[:, None] * x[offset:]
    return product


def _solved(matrix: FloatArray, diagonals: list[FloatArray], free: BoolArray, right: FloatArray) -> FloatArray:
    """(f, c) unknowns that are free, 0 of the others."""
    matrices = matrix * (free[:, :, None] & free[:, None, :])
    number = np.arange(matrix.shape[1])
    matrices[:, number, number] += ~free
    if not diagonals:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])
    matrices[:, number, number] += diagonals[0][:, None] * free
    f, c = free.shape
    band = np.zeros(((len(diagonals) - 1) * c + c + 1, f, c))[: max(c, (len(diagonals) - 1) * c + 1)]
    for offset in range(c):
        band[offset, :, : c - offset] = np.diagonal(matrices, -offset, 1, 2)
    for offset, values in enumerate(diagonals[1:], 1):
        band[offset * c, :-offset] = values[:, None] * (free[:-offset] & free[offset:])
    found = solveh_banded(band.reshape(len(band), f * c), right.ravel(), lower=True, check_finite=False)
    return np.asarray(found).reshape(f, c)
