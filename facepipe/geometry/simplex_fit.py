"""Least squares over products of simplices: shares of sources, region by region, that explain a target best.

    minimise 1/2 a.G a - g.a   over R groups of K shares, each share 0 or more and each group summing to 1

G may have any rank. The problem is solved as a short run of strictly convex ones, each with a faint pull towards the
solution of the one before, the first towards equal shares (Rockafellar, "Monotone operators and the proximal point
algorithm", SIAM J. Control Optim. 1976): they end at a minimum of the given problem, and what it leaves open stays
equal. Accelerated projected gradients find most of the shares that are 0; from there on the primal active-set
method is exact (Nocedal and Wright, "Numerical Optimization", algorithm 16.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import FitError

_PROXIMAL_PULL = 1e-8  # towards the step before, relative to the largest curvature
_SETTLED_GAP = 1e-11  # gap at which steps end
_LARGEST_GAP = 1e-9  # largest gap of a usable result
_PROXIMAL_STEPS = 50
_GRADIENT_STEPS = 200
_ROUNDING_SLOPE = 1e-13  # slope that is rounding


@dataclass(frozen=True)
class SimplexFit:
    """Shares that minimise the problem."""

    weights: FloatArray  # (R, K), 0 or more, rows summing to 1
    # sum of share * (slope - least slope of its group): 0 where the Karush-Kuhn-Tucker conditions hold, and never less
    # than the objective's distance from its minimum; relative to the largest element of G and g
    residual: float


@dataclass(frozen=True)
class _Problem:
    """A problem with no element above 1, over v = groups * sources shares, group after group."""

    gram: FloatArray  # (v, v)
    linear: FloatArray  # (v,)
    sources: int

    def slopes(self, shares: FloatArray) -> FloatArray:
        return np.asarray(self.gram @ shares - self.linear)

    def gap(self, shares: FloatArray) -> float:
        slopes = self.slopes(shares).reshape(-1, self.sources)
        above = slopes - slopes.min(axis=1, keepdims=True)
        return float((shares.reshape(slopes.shape) * above).sum())

    def pulled(self, centre: FloatArray, strength: float) -> _Problem:
        """The problem with ``strength / 2 |a - centre|^2`` added."""
        gram = self.gram + strength * np.eye(len(self.linear))
        return _Problem(gram, self.linear + strength * centre, self.sources)


def fit_simplex(
    gram: FloatArray,
    linear: FloatArray,
    groups: int,
    sources: int,
    *,
    locked: Mapping[int, FloatArray] | None = None,
) -> SimplexFit:
    """The shares (R, K) that minimise ``1/2 a.G a - g.a``, every share 0 or more, every group summing to 1.

    Shares that the problem leaves open are equal.

    :param gram: G (R K, R K), symmetric positive semidefinite, group after group
    :param linear: g (R K,)
    :param groups: R
    :param sources: K, at least 1
    :param locked: group -> its shares (K,), kept as given
    :raises FitError: rounding left no usable result
    """
    shares, free = np.full((groups, sources), 1.0 / sources), np.ones(groups, dtype=np.bool_)
    for group, row in (locked or {}).items():
        shares[group], free[group] = row, False
    if not free.any():
        return SimplexFit(shares, 0.0)
    problem = _without(gram, linear, np.repeat(free, sources), shares)
    curvature = float(np.abs(np.diag(problem.gram)).max()) or 1.0
    centre = shares[free].ravel()
    # active sets change one share a solve: 12 groups of 40 sources take 344 solves and 0.41 s from equal shares, and 2
    # solves and 0.02 s from where gradients end
    minimum = _descend(problem.pulled(centre, _PROXIMAL_PULL * curvature), centre)
    for _ in range(_PROXIMAL_STEPS):
        centre = minimum = _solve(problem.pulled(centre, _PROXIMAL_PULL * curvature), minimum)
        if problem.gap(minimum) <= _SETTLED_GAP:
            break
    residual = problem.gap(minimum)
    if not residual <= _LARGEST_GAP:
        raise FitError("shares", f"no minimum found: a gap of {residual:.1e}, expected at most {_LARGEST_GAP:g}")
    shares[free] = minimum.reshape(-1, sources)
    return SimplexFit(shares, residual)


def _without(gram: FloatArray, linear: FloatArray, free: BoolArray, shares: FloatArray) -> _Problem:
    """The problem of the `free` (v,) shares, the others held, scaled."""
    symmetric = (gram + gram.T) / 2
    left = symmetric[np.ix_(free, free)]
    pull = linear[free] - symmetric[np.ix_(free, ~free)] @ shares.ravel()[~free]
    scale = max(float(np.abs(left).max()), float(np.abs(pull).max())) or 1.0
    return _Problem(left / scale, pull / scale, shares.shape[1])


def _projected(rows: FloatArray) -> FloatArray:
    """The nearest rows of shares (Held, Wolfe and Crowder 1974); rows that are shares already stay bit for bit."""
    down = -np.sort(-rows, axis=1)
    excess = (np.cumsum(down, axis=1) - 1.0) / np.arange(1, rows.shape[1] + 1)
    last = (down > excess).sum(axis=1) - 1
    level = excess[np.arange(len(rows)), last]
    level[np.abs(level) < 4 * np.finfo(np.float64).eps] = 0.0
    return np.asarray(np.maximum(rows - level[:, None], 0.0))


def _descend(problem: _Problem, start: FloatArray) -> FloatArray:
    """Nesterov's projected gradients, restarted where they turn uphill (O'Donoghue and Candes 2015)."""
    step = 1.0 / max(float(np.abs(problem.gram).sum(axis=1).max()), np.finfo(np.float64).tiny)
    shares, ahead, momentum = start, start, 1.0
    for _ in range(_GRADIENT_STEPS):
        moved = _projected((ahead - step * problem.slopes(ahead)).reshape(-1, problem.sources)).ravel()
        if (ahead - moved) @ (moved - shares) > 0:
            momentum = 1.0
        following = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = moved + (momentum - 1.0) / following * (moved - shares)
        shares, momentum = moved, following
    return shares


def _solve(problem: _Problem, start: FloatArray) -> FloatArray:
    """The minimum of a strictly convex problem by active sets from `start`."""
    shares, free, released = start.copy(), start > 0, -1
    most = 99 + 20 * len(start)
    for _ in range(most):
        target = _face_minimum(problem, free)
        below = np.flatnonzero(free & (target < 0))
        if len(below):
            reach = shares[below] / (shares[below] - target[below])
            hit = below[reach <= reach.min()]
            shares = shares + reach.min() * (target - shares)
            shares[hit], free[hit] = 0.0, False
            if reach.min() <= 0 and released in hit:
                return np.asarray(shares)  # its slope was rounding
            continue
        shares = target
        released, slope = _steepest(problem, shares, free)
        if slope >= -_ROUNDING_SLOPE:
            return shares
        free[released] = True
    raise FitError("shares", f"no minimum found in {most} steps")


def _face_minimum(problem: _Problem, free: BoolArray) -> FloatArray:
    """The minimum (v,) over the `free` shares of any sign, groups summing to 1, the others 0."""
    numbers = np.flatnonzero(free)
    groups = len(free) // problem.sources
    size = len(numbers)
    system = np.zeros((size + groups, size + groups))
    system[:size, :size] = problem.gram[np.ix_(numbers, numbers)]
    sums = numbers // problem.sources == np.arange(groups)[:, None]
    system[size:, :size], system[:size, size:] = sums, sums.T
    try:
        solved = np.linalg.solve(system, np.concatenate([problem.linear[numbers], np.ones(groups)]))
    except np.linalg.LinAlgError as error:
        raise FitError("shares", "no minimum found: a singular system") from error
    target = np.zeros(len(free))
    target[numbers] = solved[:size]
    return target


def _steepest(problem: _Problem, shares: FloatArray, free: BoolArray) -> tuple[int, float]:
    """The share held at 0 whose slope is the furthest below those of the free shares of its group, and how far."""
    slopes = problem.slopes(shares).reshape(-1, problem.sources)
    inside = free.reshape(slopes.shape)
    level = np.where(inside, slopes, 0.0).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
    above = np.where(inside, np.inf, slopes - level[:, None]).ravel()
    steepest = int(above.argmin())
    return steepest, float(above[steepest])
