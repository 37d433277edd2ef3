"""Convex quadratic problems in a box: min 1/2 x^T H x + g^T x with lower <= x <= upper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_STEPS = 60
_SETTLED = 1e-12  # of the largest slope at the start
_ARMIJO = 1e-4


@dataclass(frozen=True)
class BoxedSolution:
    """The minimiser, and the largest slope left: along free variables, or into the box at its bounds."""

    x: FloatArray  # (n,)
    residual: float
    steps: int


def solve_boxed(hessian: FloatArray, linear: FloatArray, lower: FloatArray, upper: FloatArray) -> BoxedSolution:
    """The minimiser of one problem; arguments and errors as those of `BoxedQuadratic`."""
    return BoxedQuadratic(hessian).minimise(linear, lower, upper)


class BoxedQuadratic:
    """Problems that share their matrix: the factor stays for as long as the same variables are free.

    Projected Newton steps: Cholesky over the variables that no bound holds, along the path bent at the bounds.
    Source: Bertsekas, "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control
    Optim. 1982.

    :param hessian: (n, n) symmetric positive definite
    """

    def __init__(self, hessian: FloatArray) -> None:
        self.hessian = hessian
        self._free: IntArray | None = None
        self._factor: tuple[FloatArray, bool] | None = None

    def minimise(self, linear: FloatArray, lower: FloatArray, upper: FloatArray) -> BoxedSolution:
        """From 0.

        :param lower: (n,) at most 0: 0 must lie in the box
        :param upper: (n,) at least 0
        :raises numpy.linalg.LinAlgError: H is not positive definite
        """
        x = np.zeros(len(linear))
        slope = np.array(linear, dtype=np.float64)
        enough = _SETTLED * float(np.abs(slope).max(initial=0.0))
        for step in range(_STEPS):
            held = ((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0))
            free = np.flatnonzero(~held)
            residual = float(np.abs(slope[free]).max(initial=0.0))
            if residual <= enough:
                return BoxedSolution(x, residual, step)
            direction = np.zeros(len(x))
            direction[free] = self._newton(free, slope[free])
            moved, change = _along(self.hessian, x, slope, direction, lower, upper)
            if not moved.any():  # bent at the bounds, a Newton direction may lead uphill; the slope's never does
                moved, change = _along(self.hessian, x, slope, -slope / np.diag(self.hessian), lower, upper)
            if not moved.any():
                return BoxedSolution(x, residual, step)
            x = np.clip(x + moved, lower, upper)
            slope = slope + change
        return BoxedSolution(x, residual, _STEPS)

    def _newton(self, free: IntArray, slope: FloatArray) -> FloatArray:
        """(f,) the step that makes the slope of the free variables 0."""
        from scipy.linalg import cho_factor, cho_solve

        if self._free is None or not np.array_equal(free, self._free):
            own = self.hessian if len(free) == len(self.hessian) else self.hessian[np.ix_(free, free)]
            # transposed, the same matrix lies as LAPACK wants it
            self._factor = cho_factor(own.T, lower=True, overwrite_a=own is not self.hessian, check_finite=False)
            self._free = free
        return -np.asarray(cho_solve(self._factor, slope, check_finite=False))


def _along(
    hessian: FloatArray, x: FloatArray, slope: FloatArray, direction: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The step taken, shortened until the objective falls enough, and how much the slope changes by it."""
    length = 1.0
    while length > 1e-12:
        moved = np.clip(x + length * direction, lower, upper) - x
        change = hessian @ moved
        fall = float(slope @ moved)
        if fall + 0.5 * float(moved @ change) <= _ARMIJO * fall:
            return moved, change
        length *= 0.5
    return np.zeros(len(x)), np.zeros(len(x))
