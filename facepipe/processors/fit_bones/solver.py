"""Bone coefficients that bring a skinned face to a target: damped Gauss-Newton steps inside the limits.

Source: the bone driving coefficients document: deform, compare, solve ``A x = b`` within limits, update, until every
point is within the threshold. Here A is the analytic Jacobian, and each step the exact minimum of the boxed quadratic
model (Levenberg 1944, Marquardt 1963, with the damping of Nielsen 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.geometry.boxed_qp import BoxedQuadratic
from facepipe.processors.fit_bones.moments import Moments, SkinnedPoints
from facepipe.processors.fit_bones.tree import Pose, Tree
from facepipe.rig import rest_coefficients

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_START = 1e-3  # damping, relative to the diagonal of the normal matrix
_LEAST = 1e-12
_MOST = 1e12
_KEPT = 0.5  # of the slope: what a step may leave of it for the normal matrix to stay
_FLAT = 1e-9  # of the largest diagonal element: damping of coefficients that move nothing
SETTLED = 1e-11  # relative fall of the objective that counts as none


@dataclass(frozen=True)
class Problem:
    """One fit: what may move, how far, and where to."""

    target: FloatArray  # (n, 3) world points
    weights: FloatArray  # (n,) of points, 0 or more
    lower: FloatArray  # (m, 9)
    upper: FloatArray  # (m, 9)
    free: IntArray  # (f,) joints that may move
    threshold: float  # largest distance that is good enough, in stage units
    steps: int  # at most
    settled: float = SETTLED  # relative fall of the objective that ends the steps, once a tenth of its root is all
    # that is left of the slope: near an optimum the one goes with the square of the other
    pull: FloatArray | None = None  # (m, 9) springs to rest, added to half the weighted squared distance


@dataclass(frozen=True)
class Fitted:
    """Where the steps ended."""

    coefficients: FloatArray  # (m, 9), within the limits
    points: FloatArray  # (n, 3)
    largest: float  # distance of a point with weight, stage units
    steps: int
    slope: float  # largest projected derivative left, relative to the first: 0 at a constrained optimum


def fit(tree: Tree, skin: SkinnedPoints, moments: Moments, problem: Problem, start: FloatArray) -> Fitted:
    """Least squares from `start` (m, 9), which is brought into the limits first."""
    state = _State(tree, skin, problem, np.clip(start, problem.lower, problem.upper))
    damping, first, slope, before, taken = _START, 0.0, 0.0, np.inf, 0
    model: _Model | None = None
    while taken < problem.steps:
        if state.largest <= problem.threshold:
            break
        generators = tree.generators(state.pose)
        by_matrix = moments.gradient(state.pose.skinning)
        gradient = tree.gradient(generators, state.pose, by_matrix, problem.free) + state.pulled()
        slope = _projected(gradient, state.pose, problem)
        first = first or slope
        if slope <= problem.settled * first:
            break
        kept = model is not None and slope <= _KEPT * before
        if model is None or not kept:
            model = _Model(tree.normal_matrix(generators, state.pose, moments.pairs, problem.free), problem, damping)
        tried, damping = _descend(state, model, gradient, kept)
        stalled = tried is None or state.objective - tried.objective <= problem.settled * state.objective
        if tried is not None:
            state, taken, before = tried, taken + 1, slope
        if stalled and not kept and (tried is None or slope <= 0.1 * np.sqrt(problem.settled) * first):
            break
        if stalled:
            model = None  # too old
    return Fitted(state.pose.coefficients, state.points, state.largest, taken, slope / first if first else 0.0)


class _Model:
    """The damped quadratic around a pose. It serves the poses after it too, while steps to its minimum go well."""

    def __init__(self, normal: FloatArray, problem: Problem, damping: float) -> None:
        if problem.pull is not None:
            normal[np.diag_indices_from(normal)] += problem.pull[problem.free].ravel()
        self.normal = normal
        self._diagonal = np.diag(normal).copy()
        largest = max(float(self._diagonal.max(initial=0.0)), np.finfo(np.float64).tiny)
        self._floor = np.maximum(self._diagonal, _FLAT * largest)
        self.damp(damping)

    def damp(self, damping: float) -> None:
        """Another damping."""
        self.damping = damping
        damped = self.normal.copy()
        damped[np.diag_indices_from(damped)] += damping * self._floor
        self.damped = BoxedQuadratic(damped)


def _descend(state: _State, model: _Model, gradient: FloatArray, kept: bool) -> tuple[_State | None, float]:
    """The next state that is better, and the damping for the model after it; None where there is none.

    A model of an earlier pose is tried once.
    """
    problem, pose, growth = state.problem, state.pose, 2.0
    low, high = ((bound - pose.coefficients)[problem.free].ravel() for bound in (problem.lower, problem.upper))
    while model.damping < _MOST:
        found = model.damped.minimise(gradient, low, high)
        tried = state.moved(found.x)
        expected = -float(gradient @ found.x) - 0.5 * float(found.x @ (model.normal @ found.x))
        if tried.objective < state.objective and expected > 0:
            ratio = (state.objective - tried.objective) / expected
            return tried, max(model.damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), _LEAST)
        if kept:
            break
        model.damp(model.damping * growth)
        growth *= 2.0
    return None, model.damping


class _State:
    """A pose and how far it is from the target."""

    def __init__(self, tree: Tree, skin: SkinnedPoints, problem: Problem, coefficients: FloatArray) -> None:
        self._tree, self._skin, self.problem = tree, skin, problem
        self.pose = tree.pose(coefficients)
        self.points = skin.evaluate(self.pose.skinning, tree.parent_world)
        squares = ((self.points - problem.target) ** 2).sum(axis=1)
        self.objective = 0.5 * float(problem.weights @ squares)
        if problem.pull is not None:
            self.objective += 0.5 * float((problem.pull * self._strain() ** 2).sum())
        self.largest = float(np.sqrt(squares[problem.weights > 0].max(initial=0.0)))

    def pulled(self) -> FloatArray | float:
        """(9 f,) what the springs add to the gradient."""
        pull, free = self.problem.pull, self.problem.free
        return 0.0 if pull is None else (pull * self._strain())[free].ravel()

    def _strain(self) -> FloatArray:
        return self.pose.coefficients - rest_coefficients(len(self.pose.coefficients))

    def moved(self, change: FloatArray) -> _State:
        """The state after a change (9 f,) of the free joints' coefficients."""
        problem, coefficients = self.problem, self.pose.coefficients.copy()
        coefficients[problem.free] += change.reshape(-1, 9)
        return _State(self._tree, self._skin, problem, np.clip(coefficients, problem.lower, problem.upper))


def _projected(gradient: FloatArray, pose: Pose, problem: Problem) -> float:
    """The largest derivative that a step inside the limits could still follow."""
    own = pose.coefficients[problem.free].ravel()
    held = ((own <= problem.lower[problem.free].ravel()) & (gradient > 0)) | (
        (own >= problem.upper[problem.free].ravel()) & (gradient < 0)
    )
    return float(np.abs(gradient[~held]).max(initial=0.0))
