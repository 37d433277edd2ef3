"""Convex quadratic problems in a box: min 1/2 x^T H x + g^T x with lower <= x <= upper."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray

_NEWTON_STEPS = 60
_SETTLED_SLOPE = 1e-12  # of the largest slope at the start
_ARMIJO = 1e-4
_JAMMED_ROOM = 1e-6  # of a step: room for less is none
_VARIABLES_PER_HELD = 16  # of this many variables one may be held for the factor of all to serve


class BoxedQuadratic:
    """Problems that share their matrix, and mostly its factor: a few variables at their bounds need none of their own.

    Projected Newton steps: over the variables f that no bound holds ``d_f = -H_ff^-1 (H x + g)_f``, along the path bent
    at the bounds. Where the sign of the slope holds the others (Karush-Kuhn-Tucker), x is the minimiser.
    Source: Bertsekas, "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control
    Optim. 1982.

    :param hessian: (n, n) symmetric positive definite
    """

    def __init__(self, hessian: FloatArray) -> None:
        self.hessian = hessian
        self._factored = np.zeros(len(hessian), dtype=np.bool_)
        self._factor: tuple[FloatArray, bool] | None = None

    def minimise(self, linear: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """(n,) the minimiser, from 0.

        :param lower: (n,) at most 0: 0 must lie in the box
        :param upper: (n,) at least 0
        :raises numpy.linalg.LinAlgError: H is not positive definite
        """
        x: FloatArray = np.zeros(len(linear))
        slope: FloatArray = np.array(linear, dtype=np.float64)
        enough = _SETTLED_SLOPE * float(np.abs(slope).max(initial=0.0))
        jammed = np.zeros(len(x), dtype=np.bool_)
        for _ in range(_NEWTON_STEPS):
            held = ((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0))
            if np.abs(slope[~held]).max(initial=0.0) <= enough:
                break
            direction = self._newton(held | jammed, lower < upper, slope)
            ahead, change = _along(self.hessian, x, slope, direction, lower, upper)
            if ahead is not x:
                x, slope, jammed = ahead, slope + change, np.zeros_like(jammed)
                continue
            # bent at the box a Newton step may lead uphill, however short: what a rounding keeps off its bound goes
            # onto it, and stays out until a step succeeds
            stopped = _stopped(x, direction, lower, upper) & ~jammed
            if not stopped.any():
                break
            at_bound = np.where(stopped, np.where(direction < 0, lower, upper), x)
            slope = slope + self.hessian @ (at_bound - x)
            x, jammed = at_bound, jammed | stopped
        return x

    def _newton(self, held: BoolArray, movable: BoolArray, slope: FloatArray) -> FloatArray:
        """(n,) the step that makes the slope of all variables 0 that are not `held`.

        With the factor of more variables than move, the held ones h get forces that undo their steps:
        ``d = d' - Y (Y_h)^-1 d'_h`` where d' is the step of all in the factor and Y the answers of its inverse to unit
        forces on h. A few solves are cheaper than a factor.
        """
        from scipy.linalg import cho_solve

        few = len(slope) // _VARIABLES_PER_HELD
        # factors made anew whenever others are held take 2.5 times as long (ten problems of 396 variables)
        if self._factor is None or (~held & ~self._factored).any() or (held & self._factored).sum() > few:
            self._refactor(movable if (held & movable).sum() <= few else ~held)
        inside = np.flatnonzero(self._factored)
        step = -np.asarray(cho_solve(self._factor, slope[inside], check_finite=False))
        stopped = np.flatnonzero(held[inside])
        if len(stopped):
            answers = np.zeros((len(inside), len(stopped)))
            answers[stopped, np.arange(len(stopped))] = 1.0
            answers = np.asarray(cho_solve(self._factor, answers, overwrite_b=True, check_finite=False))
            step -= answers @ np.linalg.solve(answers[stopped], step[stopped])
        direction = np.zeros(len(slope))
        direction[inside] = step
        direction[held] = 0.0
        return direction

    def _refactor(self, chosen: BoolArray) -> None:
        from scipy.linalg import cho_factor

        free = np.flatnonzero(chosen)
        matrix = self.hessian if len(free) == len(self.hessian) else self.hessian[np.ix_(free, free)]
        # transposed, the same matrix lies as LAPACK wants it
        self._factor = cho_factor(matrix.T, lower=True, overwrite_a=matrix is not self.hessian, check_finite=False)
        self._factored = chosen


def _stopped(x: FloatArray, direction: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """(n,) variables that the box stops at once: hardly off a bound, by rounding, they keep all others from moving."""
    room = np.where(direction < 0, x - lower, upper - x)
    return np.asarray((direction != 0) & (room <= _JAMMED_ROOM * np.abs(direction)))


def _along(
    hessian: FloatArray, x: FloatArray, slope: FloatArray, direction: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The end of the step, shortened until the objective falls enough (Armijo's rule), and the change of the slope."""
    length = 1.0
    while length > 1e-12:
        ahead = np.clip(x + length * direction, lower, upper)  # exactly at bounds: a rounding off would jam later steps
        moved = ahead - x
        if not moved.any():
            break
        change = hessian @ moved
        fall = float(slope @ moved)
        if fall + 0.5 * float(moved @ change) <= _ARMIJO * fall:
            return ahead, change
        length *= 0.5
    return x, np.zeros(len(x))
