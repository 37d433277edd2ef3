"""Bone coefficients that bring a skinned face to a target: damped Gauss-Newton steps inside the limits.

Source: the bone driving coefficients document: deform, compare, solve ``A x = b`` within limits, update, until every
point is within the threshold. Here A is the analytic Jacobian, and each step the exact minimum of the boxed quadratic
model (Levenberg 1944, Marquardt 1963, with the damping of Nielsen 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.bounded_least_squares import BoxedQuadratic
from facepipe.rig import rest_coefficients
from facepipe.verbs.fit_bones.skinning import Tree, Variables, applied, slopes, stacked

_START = 1e-3  # damping, relative to the diagonal of the normal matrix
_LEAST = 1e-12
_MOST = 1e12
_KEPT = 0.5  # of the slope: what a step may leave of it for the model to stay
_SLOW = 0.2  # fall of the objective, relative: below it a model takes in the curvature
_FLAT = 1e-9  # of the largest diagonal element: damping of coefficients that move nothing
_ROUNDING = 1e-13  # of the objective: differences that mean nothing
SETTLED = 2e-7  # cosine between what is left and what the coefficients can still do about it
_DAMPING = 1e-4  # of the first matrix, relative to the diagonal
_LEAST_DAMPED = 1e-6  # of the largest diagonal element: what the damping of others is relative to at least
_ENOUGH = 0.1  # of the threshold: root of the mean square at which steps end that don't see the largest distance
_MEMORY = 12  # pairs of changes of coefficients and gradients
_ARMIJO = 1e-4
_HELD_ROUNDS = 4
_SHORTEST = 1 / 32
_CURVED = 1e-10  # cosine of a pair: a lower one is no curvature
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class Problem:
    """What may move, how far, and how it counts: what the fits of one rig have in common."""

    tree: Tree
    weights: FloatArray  # (n,) of points, 0 or more
    pairs: FloatArray  # (4m, 4m) moments ``Q`` of the points under the weights
    variables: Variables  # v of them
    metric: FloatArray  # (v,) root of the normal matrix's diagonal at rest: how far an unknown moves the points
    pull: FloatArray | None  # (m, 9) springs to rest, added to half the weighted squared distance


@dataclass(frozen=True)
class Fitted:
    """Where the steps ended."""

    coefficients: FloatArray  # (m, 9), within the limits
    points: FloatArray  # (n, 3)
    largest: float  # distance of a point with weight, stage units
    steps: int
    slope: float  # largest cosine between what is left and what an unknown still does: 0 at a constrained optimum
    capped: bool = False  # that many steps were not enough, for the threshold or an optimum


def fit(
    problem: Problem,
    target: FloatArray,
    goal: FloatArray,
    start: FloatArray,
    *,
    threshold: float,
    steps: int,
    settled: float = SETTLED,
) -> Fitted:
    """Least squares from `start` (m, 9), what may move of it brought into the limits first.

    :param target: (n, 3) world points
    :param goal: (4m, 3) their moments ``T``
    :param threshold: largest distance that is good enough, in stage units
    :param steps: at most

    Models leave the curvature out, which makes them convex, as long as the objective falls fast without (Fletcher and
    Xu, "Hybrid methods for nonlinear least squares", IMA J. Numer. Anal. 1987).
    """
    state = _State(problem, target, goal, problem.variables.reduced(start), start)
    damping, before, taken, exact = _START, np.inf, 0, False
    model: _Model | None = None
    while taken < steps and state.largest > threshold and state.slope > settled:
        # a model is a normal matrix and its factor: it serves on while a step leaves half the slope at most
        kept = model is not None and state.slope <= _KEPT * before
        if model is None or not kept:
            model = _Model(state, damping, exact)
        tried, damping = _descend(state, model, kept)
        if tried is not None:
            exact = exact or (not kept and tried.objective > (1 - _SLOW) * state.objective)
            state, taken, before = tried, taken + 1, state.slope
        elif kept:
            model = None  # too old
        elif not exact:
            model, exact, damping = None, True, _START
        else:
            break
    capped = taken == steps and state.largest > threshold and state.slope > settled
    return Fitted(state.pose.coefficients, state.points, state.largest, taken, state.slope, capped)


class _Model:
    """The damped quadratic around a pose. It serves the poses after it too, while steps to its minimum go well."""

    def __init__(self, state: _State, damping: float, exact: bool) -> None:
        problem, tree, pose = state.problem, state.problem.tree, state.pose
        generators, joints = tree.generators(pose), problem.variables.joints
        hessian = tree.normal_matrix(generators, pose, problem.pairs, joints)
        if problem.pull is not None:
            hessian[np.diag_indices_from(hessian)] += problem.pull[joints].ravel()
        self.hessian = problem.variables.matrix(hessian)
        self._floor = problem.variables.floored(np.diag(self.hessian), _FLAT)
        if exact:
            curvature = tree.curvature(generators, pose, state.by_matrix, joints)
            self.hessian = self.hessian + problem.variables.matrix(curvature)
        self.damp(damping)

    def damp(self, damping: float) -> None:
        """Another damping."""
        self.damping = damping
        damped = self.hessian.copy()
        damped[np.diag_indices_from(damped)] += damping * self._floor
        self.damped = BoxedQuadratic(damped)


def _descend(state: _State, model: _Model, kept: bool) -> tuple[_State | None, float]:
    """The next state that is better, and the damping for the model after it; None where there is none.

    A model of an earlier pose is tried once.
    """
    variables, growth = state.problem.variables, 2.0
    low, high = variables.lower - state.x, variables.upper - state.x
    while model.damping < _MOST:
        hopeless = False
        try:
            step = model.damped.minimise(state.gradient, low, high)
        except np.linalg.LinAlgError:  # no minimum
            pass
        else:
            tried = state.moved(step)
            expected = -float(state.gradient @ step) - 0.5 * float(step @ (model.hessian @ step))
            if tried.better_than(state) and expected > 0:
                # Nielsen: gain over the model's gain; 1 cuts the damping to a third, 1/2 keeps it, less raises it
                ratio = (state.objective - tried.objective) / expected
                return tried, max(model.damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), _LEAST)
            hopeless = expected <= _ROUNDING * state.objective
        if kept or hopeless:
            break
        model.damp(model.damping * growth)
        growth *= 2.0
    return None, model.damping


class _State:
    """A pose and how far it is from the target."""

    def __init__(
        self, problem: Problem, target: FloatArray, goal: FloatArray, x: FloatArray, others: FloatArray
    ) -> None:
        self.problem, self.x, self._target, self._goal = problem, x, target, goal
        self.pose = problem.tree.pose(problem.variables.expanded(x, others))
        self.points = problem.tree.evaluate(self.pose.skinning)
        squares = ((self.points - target) ** 2).sum(axis=1)
        self.objective = 0.5 * float(problem.weights @ squares)
        if problem.pull is not None:
            self.objective += 0.5 * float((problem.pull * self._strain() ** 2).sum())
        self.largest = float(np.sqrt(squares[problem.weights > 0].max(initial=0.0)))

    @cached_property
    def by_matrix(self) -> FloatArray:
        """(m, 4, 3) derivatives by the skinning matrices' rows."""
        return slopes(self.problem.pairs, self._goal, self.pose.skinning)

    @cached_property
    def gradient(self) -> FloatArray:
        """(v,) derivatives by the unknowns."""
        by_coefficient = self.problem.tree.gradient(self.pose, self.by_matrix)
        if self.problem.pull is not None:
            by_coefficient += self.problem.pull * self._strain()
        return self.problem.variables.gradient(by_coefficient)

    @cached_property
    def slope(self) -> float:
        """The largest cosine between what is left and what an unknown does, of those a limit does not hold."""
        variables, metric = self.problem.variables, self.problem.metric
        held = (self.x <= variables.lower) & (self.gradient > 0)
        held |= (self.x >= variables.upper) & (self.gradient < 0)
        largest = float(np.abs(self.gradient / metric)[~held].max(initial=0.0))
        return largest / float(np.sqrt(2.0 * max(self.objective, np.finfo(np.float64).tiny)))

    def better_than(self, other: _State) -> bool:
        """Lower; or flatter, where rounding hides which is lower."""
        unseen = _ROUNDING * other.objective
        if self.objective < other.objective - unseen:
            return True
        return self.objective <= other.objective + unseen and self.slope < _KEPT * other.slope

    def _strain(self) -> FloatArray:
        return self.pose.coefficients - rest_coefficients(len(self.pose.coefficients))

    def moved(self, change: FloatArray) -> _State:
        """The state after a change (v,) of the unknowns."""
        variables = self.problem.variables
        x = np.clip(self.x + change, variables.lower, variables.upper)
        return _State(self.problem, self._target, self._goal, x, self.pose.coefficients)


def inverse(normal: FloatArray, variables: Variables) -> FloatArray:
    """(v, v) inverse of the normal matrix at rest (v, v), slightly damped."""
    from scipy.linalg import lapack

    if not len(normal):  # LAPACK takes none that are empty
        return normal
    damped = normal + np.diag(_DAMPING * variables.floored(np.diag(normal), _LEAST_DAMPED))
    lower = lapack.dpotri(lapack.dpotrf(damped, lower=True)[0], lower=True)[0]
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def fit_together(
    shared: Problem, inverse: FloatArray, targets: FloatArray, start: FloatArray, steps: int, threshold: float
) -> list[Fitted]:
    """Fits of (K, n, 3) from (m, 9) coefficients, in at most `steps` steps: not every one ends at an optimum.

    :param inverse: (v, v) about that of the normal matrix at rest, as `inverse` makes it
    """
    objective, memory = _Objective(shared, targets, start), _Memory(inverse)
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
        # (k, v) where to go; unknowns at a limit that would go beyond it are held, and the others follow
        inside = ~objective.held(states, states.gradient)
        for _ in range(_HELD_ROUNDS):
            direction = memory.direction(states.gradient, inside)
            beyond = inside & objective.held(states, -direction)
            if not beyond.any():
                break
            inside &= ~beyond
        ahead, better = _searched(objective, states, direction)
        memory.add(ahead.x - states.x, ahead.gradient - states.gradient)
        going = better | memory.forget(~better)
        memory.keep(going)
        states = ahead.only(going)
    found, tree = [], shared.tree
    for number, own in enumerate(shared.variables.expanded(ends, start)):
        points = tree.evaluate(tree.pose(own).skinning)
        largest = float(np.linalg.norm(points - targets[number], axis=1)[shared.weights > 0].max(initial=0.0))
        found.append(Fitted(own, points, largest, int(taken[number]), float(slopes[number])))
    return found


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

    def __init__(self, shared: Problem, targets: FloatArray, start: FloatArray) -> None:
        self._shared, self._start = shared, start
        self._rest = rest_coefficients(len(start))
        self._at_rest = shared.tree.pose(self._rest).skinning
        way = targets - shared.tree.evaluate(self._at_rest)
        self._far = 0.5 * (way**2).sum(axis=2) @ shared.weights
        weighted = (shared.weights[:, None, None] * way.transpose(1, 0, 2)).reshape(len(shared.weights), -1)
        goals = np.asarray(shared.tree.rows.T @ weighted).reshape(-1, len(way), 3)
        self._goals = np.ascontiguousarray(goals.transpose(1, 0, 2))  # (K, 4m, 3)
        self.low, self.high = shared.variables.lower, shared.variables.upper

    def at(self, rows: IntArray, x: FloatArray) -> _States:
        """The states there."""
        shared, coefficients = self._shared, self._shared.variables.expanded(x, self._start)
        pose = shared.tree.pose(coefficients)
        way, goal = stacked(pose.skinning - self._at_rest), self._goals[rows]
        slope = applied(shared.pairs, way) - goal
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
        scales = []
        for x, change in pairs:
            # one over the product of a pair; 0 where it shows no curvature
            product = (x * change).sum(axis=1)
            curved = product > _CURVED * np.linalg.norm(x, axis=1) * np.linalg.norm(change, axis=1)
            scales.append(np.where(curved, 1.0 / np.where(curved, product, 1.0), 0.0))
        for (x, change), scale in zip(reversed(pairs), reversed(scales), strict=True):
            shares.append(scale * (x * left).sum(axis=1))
            left -= shares[-1][:, None] * change
        # (k, v) the shared inverse times (k, v), where held unknowns take the force that keeps them
        ahead = left @ self._inverse
        for row, held in zip(ahead, ~inside, strict=True):
            stopped = np.flatnonzero(held)
            if len(stopped):
                row -= np.linalg.solve(self._inverse[np.ix_(stopped, stopped)], row[stopped]) @ self._inverse[stopped]
        ahead = np.asarray(ahead * inside)
        for (x, change), scale, share in zip(pairs, scales, reversed(shares), strict=True):
            ahead += (share - scale * (change * ahead).sum(axis=1))[:, None] * x
        return ahead
