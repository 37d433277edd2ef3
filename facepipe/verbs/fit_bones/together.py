"""Least squares for many targets at once: steps that share one factor.

Quasi-Newton steps with limited memory (Nocedal, "Updating quasi-Newton matrices with limited storage", Math. Comp.
1980) whose first matrix is the normal matrix at rest, factored once. Moments suffice: no step sees the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.rig import rest_coefficients
from facepipe.verbs.fit_bones.skinning import Moments, SkinnedPoints, Tree, stacked
from facepipe.verbs.fit_bones.solver import SETTLED, Fitted
from facepipe.verbs.fit_bones.variables import Variables

_DAMPING = 1e-4  # of the first matrix, relative to the diagonal
_FLAT = 1e-6  # of the largest diagonal element: what the damping of others is relative to at least
_ENOUGH = 0.1  # of the threshold: root of the mean square at which steps end that don't see the largest distance
_MEMORY = 12  # pairs of changes of coefficients and gradients
_ARMIJO = 1e-4
_HELD_ROUNDS = 4
_SHORTEST = 1 / 32
_CURVED = 1e-10  # cosine of a pair: a lower one is no curvature
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, kw_only=True)
class Shared:
    """What the fits of one rig have in common."""

    tree: Tree
    skin: SkinnedPoints
    weights: FloatArray  # (n,) of points
    pairs: FloatArray  # (4m, 4m) moments of the points
    variables: Variables  # v of them
    inverse: FloatArray  # (v, v) about that of the normal matrix at rest, as `inverse` makes it
    metric: FloatArray  # (v,) as `Problem` has it
    pull: FloatArray | None = None  # (m, 9) as `Problem` has it


def inverse(normal: FloatArray, variables: Variables) -> FloatArray:
    """(v, v) inverse of the normal matrix at rest (v, v), slightly damped."""
    from scipy.linalg import lapack

    if not len(normal):  # LAPACK takes none that are empty
        return normal
    damped = normal + np.diag(_DAMPING * variables.floored(np.diag(normal), _FLAT))
    lower = lapack.dpotri(lapack.dpotrf(damped, lower=True)[0], lower=True)[0]
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def fit_together(shared: Shared, targets: FloatArray, start: FloatArray, steps: int, threshold: float) -> list[Fitted]:
    """Fits of (K, n, 3) from (m, 9) coefficients, in at most `steps` steps: not every one ends at an optimum."""
    objective, memory = _Objective(shared, targets, start), _Memory(shared.inverse)
    states = objective.at(np.arange(len(targets)), np.tile(shared.variables.reduced(start), (len(targets), 1)))
    ends, taken, slopes = states.x.copy(), np.zeros(len(targets), dtype=np.int64), np.zeros(len(targets))
    # the objective 1/2 sum_i w_i d_i^2 where every d_i is that part of the threshold
    enough = 0.5 * np.square(_ENOUGH * threshold) * float(shared.weights.sum())
    for step in range(steps + 1):
        slope = objective.slope(states)
        ends[states.rows], slopes[states.rows], taken[states.rows] = states.x, slope, step
        going = (slope > SETTLED) & (states.objective > enough)
        states = states.only(going)
        memory.keep(going)
        if not len(states.rows) or step == steps:
            break
        ahead, better = _searched(objective, states, _direction(objective, memory, states))
        memory.add(ahead.x - states.x, ahead.gradient - states.gradient)
        going = better | memory.forget(~better)
        memory.keep(going)
        states = ahead.only(going)
    found = zip(targets, shared.variables.expanded(ends, start), taken, slopes, strict=True)
    return [_fitted(shared, target, own, int(steps), float(slope)) for target, own, steps, slope in found]


def _fitted(shared: Shared, target: FloatArray, coefficients: FloatArray, steps: int, slope: float) -> Fitted:
    tree = shared.tree
    points = shared.skin.evaluate(tree.pose(coefficients).skinning, tree.parent_world)
    largest = float(np.linalg.norm(points - target, axis=1)[shared.weights > 0].max(initial=0.0))
    return Fitted(coefficients, points, largest, steps, slope)


@dataclass(frozen=True)
class _States:
    """Where some targets' fits are."""

    rows: IntArray  # (k,) which targets
    x: FloatArray  # (k, v) unknowns
    objective: FloatArray  # (k,)
    gradient: FloatArray  # (k, v)

    def only(self, chosen: BoolArray) -> _States:
        """Those of the chosen targets."""
        return _States(self.rows[chosen], self.x[chosen], self.objective[chosen], self.gradient[chosen])

    def put(self, chosen: BoolArray, others: _States) -> None:
        """In place, the `others` where they are chosen."""
        for own, other in zip(vars(self).values(), vars(others).values(), strict=True):
            own[chosen] = other


class _Objective:
    """Half the weighted squared distance, and the springs', by the unknowns, around rest."""

    def __init__(self, shared: Shared, targets: FloatArray, start: FloatArray) -> None:
        self._shared, self._start = shared, start
        self._rest = rest_coefficients(len(start))
        self._at_rest = shared.tree.pose(self._rest).skinning
        way = targets - shared.skin.evaluate(self._at_rest, shared.tree.parent_world)
        self._far = 0.5 * (way**2).sum(axis=2) @ shared.weights
        weighted = (shared.weights[:, None, None] * way.transpose(1, 0, 2)).reshape(len(shared.weights), -1)
        goals = np.asarray(shared.skin.rows.T @ weighted).reshape(-1, len(way), 3)
        self._moments = Moments(shared.pairs, np.ascontiguousarray(goals.transpose(1, 0, 2)))
        self.low, self.high = shared.variables.lower, shared.variables.upper

    def at(self, rows: IntArray, x: FloatArray) -> _States:
        """The states there."""
        shared, coefficients = self._shared, self._shared.variables.expanded(x, self._start)
        pose = shared.tree.pose(coefficients)
        way, goal = stacked(pose.skinning - self._at_rest), self._moments.goal[rows]
        slope = self._moments.applied(way) - goal
        objective = self._far[rows] + 0.5 * (way * (slope - goal)).sum(axis=(1, 2))
        gradient = shared.tree.gradient(pose, slope.reshape(len(rows), -1, 4, 3))
        if shared.pull is not None:
            strain = coefficients - self._rest
            objective += 0.5 * (shared.pull * strain**2).sum(axis=(1, 2))
            gradient += shared.pull * strain
        return _States(rows, x, objective, shared.variables.gradient(gradient))

    def held(self, states: _States, uphill: FloatArray) -> BoolArray:
        """(k, v) unknowns at a limit beyond which it goes down by (k, v)."""
        low = (states.x <= self.low) & (uphill > 0)
        return np.asarray(low | ((states.x >= self.high) & (uphill < 0)))

    def slope(self, states: _States) -> FloatArray:
        """(k,) the largest cosines."""
        free = ~self.held(states, states.gradient)
        largest = np.abs(states.gradient / self._shared.metric * free).max(axis=1, initial=0.0)
        return np.asarray(largest / np.sqrt(2.0 * np.maximum(states.objective, _TINY)))


def _direction(objective: _Objective, memory: _Memory, states: _States) -> FloatArray:
    """(k, v) where to go; unknowns at a limit that would go beyond it are held, and the others follow."""
    inside = ~objective.held(states, states.gradient)
    for _ in range(_HELD_ROUNDS):
        direction = memory.direction(states.gradient, inside)
        beyond = inside & objective.held(states, -direction)
        if not beyond.any():
            break
        inside &= ~beyond
    return direction


def _searched(objective: _Objective, states: _States, direction: FloatArray) -> tuple[_States, BoolArray]:
    """The states along (k, v) directions, bent at the limits and halved until they are better; (k,) which are.

    The others stay where they were.
    """
    length = 1.0
    ahead = objective.at(states.rows, np.clip(states.x + direction, objective.low, objective.high))
    while True:
        fall = (states.gradient * (ahead.x - states.x)).sum(axis=1)
        worse = ~(ahead.objective < states.objective + np.minimum(_ARMIJO * fall, 0.0))
        length *= 0.5
        if not worse.any():
            return ahead, ~worse
        if length < _SHORTEST:
            ahead.put(worse, states.only(worse))
            return ahead, ~worse
        shorter = np.clip(states.x[worse] + length * direction[worse], objective.low, objective.high)
        ahead.put(worse, objective.at(states.rows[worse], shorter))


class _Memory:
    """The inverse Hessian of every target that goes on: the shared inverse, and what its own steps showed since."""

    def __init__(self, inverse: FloatArray) -> None:
        self._inverse = inverse
        self._pairs: list[tuple[FloatArray, FloatArray]] = []  # changes of x and gradient, (k, v) each

    def keep(self, chosen: BoolArray) -> None:
        """Go on with fewer targets."""
        if not chosen.all():
            self._pairs = [(x[chosen], gradient[chosen]) for x, gradient in self._pairs]

    def forget(self, chosen: BoolArray) -> BoolArray:
        """Start anew with some targets; (k,) of which of them there was something to forget."""
        known = np.zeros(len(chosen), dtype=np.bool_)
        for x, change in self._pairs if chosen.any() else ():
            known |= chosen & x.any(axis=1)
            x[chosen], change[chosen] = 0.0, 0.0
        return known

    def add(self, x: FloatArray, gradient: FloatArray) -> None:
        """What one step (k, v) changed of the gradient."""
        self._pairs = [*self._pairs[1 - _MEMORY :], (x, gradient)]

    def direction(self, gradient: FloatArray, inside: BoolArray) -> FloatArray:
        """(k, v) where to go, over the unknowns `inside` the limits."""
        left, shares = -gradient * inside, []
        pairs = [(x * inside, change * inside) for x, change in self._pairs]
        scales = [_reciprocal(x, change) for x, change in pairs]
        for (x, change), scale in zip(reversed(pairs), reversed(scales), strict=True):
            shares.append(scale * (x * left).sum(axis=1))
            left -= shares[-1][:, None] * change
        ahead = self._solved(left, inside)
        for (x, change), scale, share in zip(pairs, scales, reversed(shares), strict=True):
            ahead += (share - scale * (change * ahead).sum(axis=1))[:, None] * x
        return ahead

    def _solved(self, left: FloatArray, inside: BoolArray) -> FloatArray:
        """(k, v) the shared inverse times (k, v), where held unknowns take the force that keeps them."""
        ahead = left @ self._inverse
        for row, held in zip(ahead, ~inside, strict=True):
            stopped = np.flatnonzero(held)
            if len(stopped):
                row -= np.linalg.solve(self._inverse[np.ix_(stopped, stopped)], row[stopped]) @ self._inverse[stopped]
        return np.asarray(ahead * inside)


def _reciprocal(x: FloatArray, change: FloatArray) -> FloatArray:
    """(k,) one over the products of pairs; 0 where they show no curvature."""
    product = (x * change).sum(axis=1)
    least = _CURVED * np.linalg.norm(x, axis=1) * np.linalg.norm(change, axis=1)
    return np.asarray(np.where(product > least, 1.0 / np.where(product > least, product, 1.0), 0.0))
