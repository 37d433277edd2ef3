"""Quadratic problems with bounds: in a box, of many frames at once, and of shares that sum to 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import solveh_banded

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-7, 1e8
_DAMPING_EASED, _DAMPING_RAISED, _LEAST_RAISED_DAMPING = 0.2, 8.0, 1e-4  # what a failed step raises damping to at least
_SETTLED_FALL = 1e-5  # of the cost: a fall that ends it
_HOLDING_ROUNDS = 6  # of holding what would leave the box
_FLAT_CURVATURE = 1e-10  # of the largest diagonal element
_PROXIMAL_PULL = 1e-8  # towards the step before, relative to the largest curvature
_SETTLED_GAP = 1e-11  # gap at which steps end
_LARGEST_GAP = 1e-9  # largest gap of a usable result
_PROXIMAL_STEPS = 50
_GRADIENT_STEPS = 200
_ROUNDING_SLOPE = 1e-13  # slope that is rounding
_NEWTON_STEPS = 60
_SETTLED_SLOPE = 1e-12  # of the largest slope at the start
_ARMIJO = 1e-4
_JAMMED_ROOM = 1e-6  # of a step: room for less is none
_VARIABLES_PER_HELD = 16  # of this many variables one may be held for the factor of all to serve


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
            # (f, c) of (f, c): each frame's own matrix, and what is between frames
            product: FloatArray = np.einsum("fij,fj->fi", matrix, change)
            for offset, values in enumerate(diagonals):
                if offset == 0:
                    product += values[:, None] * change
                else:
                    product[offset:] += values[:, None] * change[:-offset]
                    product[:-offset] += values[:, None] * change[offset:]
            right = pull + product
            step = _solved(matrix, diagonals, free, -np.where(free, right, 0.0))
            ahead = x + change + step
            out = free & ((ahead < low) | (ahead > high))
            if not out.any():
                return np.asarray(change + step)
            change = np.where(out, np.clip(ahead, low, high) - x, change)
            free = free & ~out
        return np.asarray(np.clip(x + change + np.where(free, step, 0.0), low, high) - x)


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
    movable = np.repeat(free, sources)
    # the problem of the shares that are not locked; scaled, so that gaps of all problems mean the same
    symmetric = (gram + gram.T) / 2
    left = symmetric[np.ix_(movable, movable)]
    pull = linear[movable] - symmetric[np.ix_(movable, ~movable)] @ shares.ravel()[~movable]
    scale = max(float(np.abs(left).max()), float(np.abs(pull).max())) or 1.0
    problem = _Problem(left / scale, pull / scale, shares.shape[1])
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


def _descend(problem: _Problem, start: FloatArray) -> FloatArray:
    """Nesterov's projected gradients, restarted where they turn uphill (O'Donoghue and Candes 2015)."""
    step = 1.0 / max(float(np.abs(problem.gram).sum(axis=1).max()), np.finfo(np.float64).tiny)
    shares, ahead, momentum = start, start, 1.0
    for _ in range(_GRADIENT_STEPS):
        rows = (ahead - step * problem.slopes(ahead)).reshape(-1, problem.sources)
        # the nearest rows of shares (Held, Wolfe and Crowder 1974); rows that are shares already stay bit for bit
        down = -np.sort(-rows, axis=1)
        excess = (np.cumsum(down, axis=1) - 1.0) / np.arange(1, rows.shape[1] + 1)
        last = (down > excess).sum(axis=1) - 1
        level = excess[np.arange(len(rows)), last]
        level[np.abs(level) < 4 * np.finfo(np.float64).eps] = 0.0
        moved = np.asarray(np.maximum(rows - level[:, None], 0.0)).ravel()
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
        # the minimum (v,) over the `free` shares of any sign, groups summing to 1, the others 0
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
        # the share held at 0 whose slope is the furthest below those of the free shares of its group, and how far
        slopes = problem.slopes(shares).reshape(-1, problem.sources)
        inside = free.reshape(slopes.shape)
        level = np.where(inside, slopes, 0.0).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        above = np.where(inside, np.inf, slopes - level[:, None]).ravel()
        steepest = int(above.argmin())
        released, slope = steepest, float(above[steepest])
        if slope >= -_ROUNDING_SLOPE:
            return shares
        free[released] = True
    raise FitError("shares", f"no minimum found in {most} steps")


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
            # (n,) variables that the box stops at once: hardly off a bound, by rounding, they keep all others from
            # moving
            room = np.where(direction < 0, x - lower, upper - x)
            stopped = np.asarray((direction != 0) & (room <= _JAMMED_ROOM * np.abs(direction))) & ~jammed
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
            chosen = movable if (held & movable).sum() <= few else ~held
            from scipy.linalg import cho_factor

            free = np.flatnonzero(chosen)
            matrix = self.hessian if len(free) == len(self.hessian) else self.hessian[np.ix_(free, free)]
            # transposed, the same matrix lies as LAPACK wants it
            self._factor = cho_factor(matrix.T, lower=True, overwrite_a=matrix is not self.hessian, check_finite=False)
            self._factored = chosen
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
