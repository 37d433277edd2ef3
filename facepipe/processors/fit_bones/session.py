"""A live bone fit: one rig prepared once, then fitted to any number of targets."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.processors.fit_bones.moments import SkinnedPoints
from facepipe.processors.fit_bones.solver import SETTLED, Fitted, Problem, fit
from facepipe.processors.fit_bones.tree import Tree
from facepipe.rig import Rig, rest_coefficients
from facepipe.threads import one_thread

FloatArray = npt.NDArray[np.floating]

LEAST_SCALE = 0.01  # where a lower limit of a scale is infinite
_LEAST_WEIGHT = 0.3  # what a point that is on its target keeps of its weight in a round of evening
_ROUGH = 1e-3  # where the next solve goes on from the end of this one
_STRAIGHT = 40  # steps: a fit that takes more may have lost its way
_SPARSE_ROUNDS = 8
LEAST_METRIC = 1e-12  # of the largest
_STILL = 0.1  # strain, in thresholds, that counts as none


class BoneFit:
    """The rig with its limits and point weights; fits that follow each other start where the last one ended.

    :param rig: m joints, n points
    :param lower: (m, 9) limits of the bone coefficients; None: none but `LEAST_SCALE`, so that no joint is mirrored
    :param upper: (m, 9)
    :param weights: (n,) how much each point counts, 0: not at all; None: all alike
    :param threshold: largest distance that is good enough, in stage units
    :param steps: at most, per solve
    :param rounds: of evening, at most, where least squares leave a point too far off; 0: plain least squares
    :param regularise: weight of the mean square strain beside the mean square distance. Strain is how far coefficients
        are from rest in stage units: translations as they are, angles and scales by a tenth of the face's size
    :param sparsity: weight of the mean strain, in thresholds: few coefficients move, the others stay exactly at rest
    :param parent_world: (4, 4) what the root joints hang under; default the skeleton's place
    :raises InputError: a negative weight, a lower limit above its upper one, arrays that don't fit, or negative weights
    """

    def __init__(
        self,
        rig: Rig,
        *,
        lower: FloatArray | None = None,
        upper: FloatArray | None = None,
        weights: FloatArray | None = None,
        threshold: float,
        steps: int = 200,
        rounds: int = 2,
        regularise: float = 0.0,
        sparsity: float = 0.0,
        parent_world: FloatArray | None = None,
    ) -> None:
        count = len(rig.joints)
        self.rig, self.threshold, self.steps, self.rounds = rig, threshold, steps, rounds
        self.lower = _limits(rig, lower, -np.inf)
        self.lower[:, 6:] = np.where(np.isinf(self.lower[:, 6:]), LEAST_SCALE, self.lower[:, 6:])
        self.upper = _limits(rig, upper, np.inf)
        crossed = np.argwhere(self.lower > self.upper)
        if len(crossed):
            joint, channel = crossed[0]
            what = f"lower limit {self.lower[joint, channel]:g} above the upper {self.upper[joint, channel]:g}"
            raise InputError(f"{rig.name} -> {rig.joints[joint]} -> channel {channel}", what)
        self.weights = np.ones(len(rig.points)) if weights is None else np.asarray(weights, dtype=np.float64)
        if self.weights.shape != (len(rig.points),) or not (np.isfinite(self.weights) & (self.weights >= 0)).all():
            raise InputError(rig.name, f"point weights {self.weights.shape}, expected {len(rig.points)} of 0 or more")
        if not (regularise >= 0 and sparsity >= 0 and np.isfinite(regularise + sparsity)):
            raise InputError(rig.name, f"regularise {regularise:g}, sparsity {sparsity:g}, expected 0 or more")
        self.regularise, self.sparsity = regularise, sparsity
        self._levers = np.repeat([1.0, 0.1 * float(np.ptp(rig.points, axis=0).max(initial=0.0))], [3, 6])
        self.tree = Tree(rig, parent_world)
        self.skin = SkinnedPoints(rig)
        self.weightless = self._weightless()
        self.free = np.flatnonzero(~self.weightless & (self.lower < self.upper).any(axis=1))
        self._moments = self.skin.moments(rig.points, self.weights, self.tree.parent_world)
        self._rest = rest_coefficients(count)
        at_rest = self.tree.pose(self._rest)
        generators = self.tree.generators(at_rest)
        self._normal = self.tree.normal_matrix(generators, at_rest, self._moments.pairs, self.free)
        diagonal = np.diag(self._normal)
        self._metric = np.sqrt(np.maximum(diagonal, LEAST_METRIC * diagonal.max(initial=np.finfo(np.float64).tiny)))
        self._at_rest = self.skin.evaluate(self.tree.pose(self._rest).skinning, self.tree.parent_world)

    def fit(self, target: FloatArray, start: FloatArray | None = None) -> Fitted:
        """The coefficients that bring the rig to (n, 3) world points: those that leave the smallest largest distance.

        Least squares from `start`; where they end too far off, again by way of the points halfway between rest and
        target, which leads round most local minima; then rounds of evening.

        :param start: (m, 9) coefficients to start from, brought into the limits; default rest
        :raises InputError: targets or coefficients of other shapes, or not finite
        """
        target = np.asarray(target, dtype=np.float64)
        if target.shape != self.rig.points.shape or not np.isfinite(target).all():
            raise InputError(self.rig.name, f"target {target.shape}, expected {self.rig.points.shape} finite numbers")
        start = self._rest if start is None else np.asarray(start, dtype=np.float64)
        if start.shape != self._rest.shape or not np.isfinite(start).all():
            raise InputError(self.rig.name, f"initial {start.shape}, expected {self._rest.shape} finite numbers")
        with one_thread():
            return self._fitted(target, start)

    def _fitted(self, target: FloatArray, start: FloatArray) -> Fitted:
        if self.sparsity > 0:
            return self._sparse(target, start)
        found = self._solve(target, start, self.weights)
        if found.largest > self.threshold and found.steps > _STRAIGHT:
            halfway = self._solve(0.5 * (self._at_rest + target), start, self.weights, settled=_ROUGH)
            found = _nearer(found, self._solve(target, halfway.coefficients, self.weights))
        return self._evened(found, target) if found.largest > self.threshold else found

    def _evened(self, found: Fitted, target: FloatArray) -> Fitted:
        """Rounds in which points count the more the further they are off: the largest distance falls, the mean rises.

        Source: Lawson, "Contributions to the theory of linear least maximum approximation", 1961: weights times
        distances, round by round.
        """
        weights, latest = self.weights, found
        for _ in range(self.rounds):
            apart = np.linalg.norm(latest.points - target, axis=1) / latest.largest
            weights = weights * (apart + _LEAST_WEIGHT)
            weights = weights * (self.weights.sum() / weights.sum())
            latest = self._solve(target, latest.coefficients, weights, settled=_ROUGH)
            found = _nearer(found, latest)
            if found.largest <= self.threshold:
                break
        return found

    def _sparse(self, target: FloatArray, start: FloatArray) -> Fitted:
        """Rounds of reweighted springs that add up to the mean absolute strain; then only what moves is fitted."""
        found = self._solve(target, start, self.weights)
        for _ in range(_SPARSE_ROUNDS):
            strain = np.abs(self._strain(found.coefficients))
            springs = self.sparsity * self.threshold / (strain + _STILL * self.threshold)
            found = self._solve(target, found.coefficients, self.weights, springs=springs, exact=True)
        still = np.abs(self._strain(found.coefficients)) < _STILL * self.threshold
        still &= (self.lower <= self._rest) & (self._rest <= self.upper)
        lower, upper = np.where(still, self._rest, self.lower), np.where(still, self._rest, self.upper)
        return self._solve(target, found.coefficients, self.weights, box=(lower, upper))

    def _solve(
        self,
        target: FloatArray,
        start: FloatArray,
        weights: FloatArray,
        *,
        springs: FloatArray | float = 0.0,
        box: tuple[FloatArray, FloatArray] | None = None,
        exact: bool = False,
        settled: float = SETTLED,
    ) -> Fitted:
        """One descent; `springs` (m, 9) are weights of each squared strain beside that of the mean square distance."""
        world = self.tree.parent_world
        if weights is self.weights:
            moments = self.skin.retargeted(self._moments, target, weights, world)
        else:
            moments = self.skin.moments(target, weights, world)
        lower, upper = box or (self.lower, self.upper)
        stiffness = np.broadcast_to(self.regularise + np.asarray(springs), lower.shape)
        share = float(weights.sum()) / max(9 * len(self.free), 1)
        pull = share * stiffness * self._levers**2 if stiffness.any() else None
        threshold = 0.0 if exact else self.threshold
        problem = Problem(target, weights, lower, upper, self.free, self._metric, threshold, self.steps, settled, pull)
        return fit(self.tree, self.skin, moments, problem, start)

    def _strain(self, coefficients: FloatArray) -> FloatArray:
        """(m, 9) how far coefficients are from rest, in stage units."""
        return np.asarray((coefficients - self._rest) * self._levers)

    def _weightless(self) -> npt.NDArray[np.bool_]:
        """(m,) joints without influence on a point that counts: they keep their place.

        What one of them does to the joints below it these can do themselves.
        """
        count = len(self.rig.joints)
        return np.asarray(abs(self.rig.influences[:, :count]).T @ (self.weights > 0)) <= 0


def _nearer(one: Fitted, other: Fitted) -> Fitted:
    return other if other.largest < one.largest else one


def _limits(rig: Rig, given: FloatArray | None, default: float) -> FloatArray:
    shape = (len(rig.joints), 9)
    limits = np.full(shape, default) if given is None else np.array(given, dtype=np.float64)
    if limits.shape != shape or np.isnan(limits).any():
        raise InputError(rig.name, f"limits {limits.shape}, expected {shape} numbers")
    return limits
