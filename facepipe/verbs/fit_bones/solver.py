"""Bone coefficients that bring a skinned face to a target: damped Gauss-Newton steps inside the limits.

Source: the bone driving coefficients document: deform, compare, solve ``A x = b`` within limits, update, until every
point is within the threshold. Here A is the analytic Jacobian, and each step the exact minimum of the boxed quadratic
model (Levenberg 1944, Marquardt 1963, with the damping of Nielsen 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.boxed_qp import BoxedQuadratic
from facepipe.rig import rest_coefficients
from facepipe.verbs.fit_bones.skinning import Moments, SkinnedPoints, Tree
from facepipe.verbs.fit_bones.variables import Variables

_START = 1e-3  # damping, relative to the diagonal of the normal matrix
_LEAST = 1e-12
_MOST = 1e12
_KEPT = 0.5  # of the slope: what a step may leave of it for the model to stay
_SLOW = 0.2  # fall of the objective, relative: below it a model takes in the curvature
_FLAT = 1e-9  # of the largest diagonal element: damping of coefficients that move nothing
_ROUNDING = 1e-13  # of the objective: differences that mean nothing
SETTLED = 2e-7  # cosine between what is left and what the coefficients can still do about it


@dataclass(frozen=True)
class Problem:
    """One fit: what may move, how far, and where to."""

    target: FloatArray  # (n, 3) world points
    weights: FloatArray  # (n,) of points, 0 or more
    variables: Variables  # v of them
    metric: FloatArray  # (v,) root of the normal matrix's diagonal at rest: how far an unknown moves the points
    threshold: float  # largest distance that is good enough, in stage units
    steps: int  # at most
    settled: float = SETTLED
    pull: FloatArray | None = None  # (m, 9) springs to rest, added to half the weighted squared distance


@dataclass(frozen=True)
class Fitted:
    """Where the steps ended."""

    coefficients: FloatArray  # (m, 9), within the limits
    points: FloatArray  # (n, 3)
    largest: float  # distance of a point with weight, stage units
    steps: int
    slope: float  # largest cosine between what is left and what an unknown still does: 0 at a constrained optimum


def fit(tree: Tree, skin: SkinnedPoints, moments: Moments, problem: Problem, start: FloatArray) -> Fitted:
    """Least squares from `start` (m, 9), what may move of it brought into the limits first.

    Models leave the curvature out, which makes them convex, as long as the objective falls fast without (Fletcher and
    Xu, "Hybrid methods for nonlinear least squares", IMA J. Numer. Anal. 1987).
    """
    setting = _Setting(tree, skin, moments, problem)
    state = _State(setting, problem.variables.reduced(start), start)
    damping, before, taken, exact = _START, np.inf, 0, False
    model: _Model | None = None
    while taken < problem.steps and state.largest > problem.threshold and state.slope > problem.settled:
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
    return Fitted(state.pose.coefficients, state.points, state.largest, taken, state.slope)


class _Model:
    """The damped quadratic around a pose. It serves the poses after it too, while steps to its minimum go well."""

    def __init__(self, state: _State, damping: float, exact: bool) -> None:
        problem, tree, pose = state.setting.problem, state.setting.tree, state.pose
        generators, joints = tree.generators(pose), problem.variables.joints
        hessian = tree.normal_matrix(generators, pose, state.setting.moments.pairs, joints)
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

    def minimiser(self, gradient: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray | None:
        """(v,) the step to the minimum inside a box; None where the quadratic has none."""
        try:
            return self.damped.minimise(gradient, low, high)
        except np.linalg.LinAlgError:
            return None


def _descend(state: _State, model: _Model, kept: bool) -> tuple[_State | None, float]:
    """The next state that is better, and the damping for the model after it; None where there is none.

    A model of an earlier pose is tried once.
    """
    variables, growth = state.setting.problem.variables, 2.0
    low, high = variables.lower - state.x, variables.upper - state.x
    while model.damping < _MOST:
        step = model.minimiser(state.gradient, low, high)
        if step is not None:
            tried = state.moved(step)
            expected = -float(state.gradient @ step) - 0.5 * float(step @ (model.hessian @ step))
            if tried.better_than(state) and expected > 0:
                # Nielsen: gain over the model's gain; 1 cuts the damping to a third, 1/2 keeps it, less raises it
                ratio = (state.objective - tried.objective) / expected
                return tried, max(model.damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), _LEAST)
            hopeless = expected <= _ROUNDING * state.objective
        if kept or (step is not None and hopeless):
            break
        model.damp(model.damping * growth)
        growth *= 2.0
    return None, model.damping


@dataclass(frozen=True)
class _Setting:
    """What all states of one fit share."""

    tree: Tree
    skin: SkinnedPoints
    moments: Moments
    problem: Problem


class _State:
    """A pose and how far it is from the target."""

    def __init__(self, setting: _Setting, x: FloatArray, others: FloatArray) -> None:
        tree, problem, self.setting, self.x = setting.tree, setting.problem, setting, x
        self.pose = tree.pose(problem.variables.expanded(x, others))
        self.points = setting.skin.evaluate(self.pose.skinning, tree.parent_world)
        squares = ((self.points - problem.target) ** 2).sum(axis=1)
        self.objective = 0.5 * float(problem.weights @ squares)
        if problem.pull is not None:
            self.objective += 0.5 * float((problem.pull * self._strain() ** 2).sum())
        self.largest = float(np.sqrt(squares[problem.weights > 0].max(initial=0.0)))

    @cached_property
    def by_matrix(self) -> FloatArray:
        """(m, 4, 3) derivatives by the skinning matrices' rows."""
        return self.setting.moments.gradient(self.pose.skinning)

    @cached_property
    def gradient(self) -> FloatArray:
        """(v,) derivatives by the unknowns."""
        by_coefficient = self.setting.tree.gradient(self.pose, self.by_matrix)
        if self.setting.problem.pull is not None:
            by_coefficient += self.setting.problem.pull * self._strain()
        return self.setting.problem.variables.gradient(by_coefficient)

    @cached_property
    def slope(self) -> float:
        """The largest cosine between what is left and what an unknown does, of those a limit does not hold."""
        variables, metric = self.setting.problem.variables, self.setting.problem.metric
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
        variables = self.setting.problem.variables
        return _State(self.setting, np.clip(self.x + change, variables.lower, variables.upper), self.pose.coefficients)
