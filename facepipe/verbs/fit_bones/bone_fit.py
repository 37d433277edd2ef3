"""A live bone fit: one rig prepared once, then fitted to any number of targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.rig import Rig, rest_coefficients
from facepipe.verbs.fit_bones.limits import check_rest, check_settings, checked_limits, checked_weights
from facepipe.verbs.fit_bones.skinning import Symmetry, Tree, Variables, symmetry
from facepipe.verbs.fit_bones.solver import SETTLED, Fitted, Problem, fit, fit_together, inverse

_LEAST_WEIGHT = 0.3  # what a point that is on its target keeps of its weight in a round of evening
_ROUGH = 1e-3  # where the next solve goes on from the end of this one
_SHARED = 80  # steps at most that targets share
_STRAIGHT = 40  # steps: a fit that takes more may have lost its way
_NEAR = 1e-2  # slope: an optimum is so near that what leads there matters little
_MANY = 64  # targets at a time
_LEAST_METRIC = 1e-6  # of the largest
_SPARSE_ROUNDS = 8
_STILL = 0.1  # strain, in thresholds, that counts as none


class BoneFit:
    """The rig with its limits and point weights, prepared for any number of targets.

    :param rig: m joints, n points
    :param lower: (m, 9) limits of the bone coefficients; None: none but `LEAST_SCALE`, so that no joint is mirrored.
        Those of a symmetric fit shrink to what both sides have
    :param upper: (m, 9)
    :param weights: (n,) how much each point counts, 0: not at all; None: all alike
    :param threshold: largest distance that is good enough, in stage units
    :param steps: at most, per solve
    :param rounds: of evening, at most, where least squares leave a point too far off; 0: plain least squares
    :param regularise: weight of the mean square strain beside the mean square distance. Strain is how far coefficients
        are from rest in stage units: translations as they are, angles and scales by a tenth of the face's size
    :param sparsity: weight of the mean strain, in thresholds: few coefficients move, the others stay exactly at rest
    :param symmetric: the joints of one side move as the mirror image of the other's
    :param parent_world: (4, 4) what the root joints hang under; default the skeleton's place
    :raises InputError: settings out of range, a lower limit above its upper one, arrays that don't fit, a joint that is
        flat at rest, or a symmetric fit of joints that are no mirror images
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
        symmetric: bool = False,
        parent_world: FloatArray | None = None,
    ) -> None:
        numbers = {"threshold": threshold, "steps": steps, "rounds": rounds}
        check_settings(rig.name, {**numbers, "regularise": regularise, "sparsity": sparsity})
        check_rest(rig, parent_world)
        self.rig, self.threshold, self.steps, self.rounds = rig, threshold, steps, rounds
        self.regularise, self.sparsity = regularise, sparsity
        self.lower, self.upper = checked_limits(rig, lower, upper)
        self.weights = checked_weights(rig, weights)
        size = float(np.ptp(rig.points, axis=0).max(initial=0.0)) or 1.0
        # a radian or a factor counts as what it moves at a tenth of the face's size, so that all channels are lengths
        self._levers = np.repeat([1.0, 0.1 * size], [3, 6])
        self.tree = Tree(rig, parent_world)
        # (m,) joints without influence on a point that counts: they keep their place. What one of them does to the
        # joints below it these can do themselves.
        count = len(self.rig.joints)
        self.weightless = np.asarray(abs(self.rig.influences[:, :count]).T @ (self.weights > 0)) <= 0
        self.symmetry: Symmetry | None = symmetry(rig, ~self.weightless) if symmetric else None
        if self.symmetry is not None:
            self.lower, self.upper = self.symmetry.limits(self.lower, self.upper)
        self.variables = self._variables(self.lower, self.upper)
        self.free = self.variables.joints  # numbers of those that may move
        self._rest = rest_coefficients(len(rig.joints))
        self._at_rest = self.tree.evaluate(self.tree.pose(self._rest).skinning)
        self._pairs, _ = self.tree.moments(rig.points, self.weights)
        metric = self._metric_of(self.variables)
        self.problem = Problem(self.tree, self.weights, self._pairs, self.variables, metric, self._pull(0.0))

    def fit(self, target: FloatArray, start: FloatArray | None = None) -> Fitted:
        """The fit of one target (n, 3), as `fit_all` makes it."""
        return self.fit_all([target], start)[0]

    def fit_all(self, targets: Sequence[FloatArray], start: FloatArray | None = None) -> list[Fitted]:
        """The coefficients that bring the rig to (n, 3) world points: those that leave the smallest largest distance;
        of plain least squares, without rounds of evening, the smallest sum of squares.

        Least squares from `start`, for all targets at once as far as that leads; where they end too far off after a
        long way, again by way of the points halfway between rest and target, which leads round most local minima; then
        rounds of evening.

        :param start: (m, 9) coefficients to start from, brought into the limits; default rest
        :raises InputError: targets or coefficients of other shapes, not finite, or too large to reckon with
        :raises numpy.linalg.LinAlgError: limits that let a joint's scale be 0, and a fit where it is
        """
        targets = [np.asarray(target, dtype=np.float64) for target in targets]
        for target in targets:
            if target.shape != self.rig.points.shape or not np.isfinite(target).all():
                what = f"target {target.shape}, expected {self.rig.points.shape} finite numbers"
                raise InputError(self.rig.name, what)
        start = self._rest if start is None else np.asarray(start, dtype=np.float64)
        if start.shape != self._rest.shape or not np.isfinite(start).all():
            raise InputError(self.rig.name, f"initial {start.shape}, expected {self._rest.shape} finite numbers")
        start = np.clip(start, self.lower, self.upper)
        batches = [targets[first : first + _MANY] for first in range(0, len(targets), _MANY)]
        fits: list[Fitted] = []
        with one_thread(), np.errstate(over="ignore", invalid="ignore"):  # steps that lead too far count as worse
            for batch in batches:
                if self.sparsity > 0:
                    fits += [self._sparse(target, start) for target in batch]
                else:
                    most = min(self.steps, _SHARED)
                    ends = fit_together(self.problem, self.inverse, np.stack(batch), start, most, self.threshold)
                    fits += [self._finished(target, start, end) for target, end in zip(batch, ends, strict=True)]
        if any((fitted.coefficients[:, 6:] == 0.0).any() for fitted in fits):
            raise np.linalg.LinAlgError("a joint of scale 0")
        if not all(np.isfinite(fitted.largest + fitted.slope) for fitted in fits):
            raise InputError(self.rig.name, "numbers of the start or the target too large to square")
        return fits

    def _finished(self, target: FloatArray, start: FloatArray, shared: Fitted) -> Fitted:
        """The fit of one target, by damped steps of its own where those it `shared` did not end at an optimum."""
        fitted = shared
        if shared.largest > self.threshold and shared.slope > SETTLED:
            fitted = self._solve(target, shared.coefficients if shared.slope < _NEAR else start, self.weights)
            if fitted.largest > self.threshold and fitted.steps > _STRAIGHT:
                halfway = self._solve(0.5 * (self._at_rest + target), start, self.weights, settled=_ROUGH)
                other = self._solve(target, halfway.coefficients, self.weights)
                # of two optima least squares are asked for the lower one, though a point of it may be farther off
                fitted = _nearer(fitted, other) if self.rounds else min(fitted, other, key=self._cost_of(target))
        # rounds in which points count the more the further they are off: the largest distance falls, the mean rises.
        # Lawson, "Contributions to the theory of linear least maximum approximation", 1961: weights times distances,
        # round by round; here their squares, which takes fewer rounds
        weights, latest = self.weights, fitted
        for _ in range(self.rounds):
            if fitted.largest <= self.threshold:
                break
            apart = np.linalg.norm(latest.points - target, axis=1) / latest.largest
            weights = weights * (apart**2 + _LEAST_WEIGHT)
            weights = weights * (self.weights.sum() / weights.sum())
            latest = self._solve(target, latest.coefficients, weights, settled=_ROUGH)
            fitted = _nearer(fitted, latest)
        return fitted

    def _cost_of(self, target: FloatArray) -> Callable[[Fitted], float]:
        """What least squares minimise."""
        pull = self._pull(0.0)

        def cost(fitted: Fitted) -> float:
            apart = self.weights @ ((fitted.points - target) ** 2).sum(axis=1)
            return float(apart + (0.0 if pull is None else (pull * (fitted.coefficients - self._rest) ** 2).sum()))

        return cost

    def _sparse(self, target: FloatArray, start: FloatArray) -> Fitted:
        """Rounds of reweighted springs that add up to the mean absolute strain; then only what moves is fitted."""
        fitted = self._solve(target, start, self.weights)
        for _ in range(_SPARSE_ROUNDS):
            strain = np.abs(self._strain(fitted.coefficients))
            springs = self.sparsity * self.threshold / (strain + _STILL * self.threshold)
            fitted = self._solve(target, fitted.coefficients, self.weights, springs=springs, threshold=0.0)
        still = np.abs(self._strain(fitted.coefficients)) < _STILL * self.threshold
        still &= (self.lower <= self._rest) & (self._rest <= self.upper)
        return self.refit(target, np.where(still, self._rest, fitted.coefficients), still)

    def refit(self, target: FloatArray, start: FloatArray, held: BoolArray) -> Fitted:
        """Least squares from `start`, where the coefficients that are `held` (m, 9) stay as they are."""
        lower, upper = np.where(held, start, self.lower), np.where(held, start, self.upper)
        return self._solve(target, start, self.weights, variables=self._variables(lower, upper))

    def _solve(
        self,
        target: FloatArray,
        start: FloatArray,
        weights: FloatArray,
        *,
        springs: FloatArray | float = 0.0,
        variables: Variables | None = None,
        threshold: float | None = None,
        settled: float = SETTLED,
    ) -> Fitted:
        """One descent; `springs` (m, 9) are weights of each squared strain beside that of the mean square distance."""
        problem = self.problem
        if weights is self.weights:
            # Q = sum w r r^T is of the weights alone, T = sum w r (target - rigid)^T of the target: Q is kept
            goal = self.tree.goal(target, weights)
        else:
            pairs, goal = self.tree.moments(target, weights)
            problem = replace(problem, weights=weights, pairs=pairs)
        if variables is not None:
            problem = replace(problem, variables=variables, metric=self._metric_of(variables))
        return fit(
            replace(problem, pull=self._pull(springs)),
            target,
            goal,
            start,
            threshold=self.threshold if threshold is None else threshold,
            steps=self.steps,
            settled=settled,
        )

    @cached_property
    def inverse(self) -> FloatArray:
        """(v, v) about that of the normal matrix at rest, which targets share."""
        return inverse(self._normal(self.variables), self.variables)

    def _variables(self, lower: FloatArray, upper: FloatArray) -> Variables:
        """What may move between (m, 9) limits."""
        return Variables(lower, upper, ~self.weightless, self._levers, self.symmetry)

    def _metric_of(self, variables: Variables) -> FloatArray:
        """(v,) root of the normal matrix's diagonal; unknowns that move nothing count as if they moved a little."""
        return np.sqrt(variables.floored(np.diag(self._normal(variables)), _LEAST_METRIC**2))

    def _normal(self, variables: Variables) -> FloatArray:
        """(v, v) normal matrix at rest."""
        pose, pull = self.tree.pose(self._rest), self._pull(0.0)
        matrix = self.tree.normal_matrix(self.tree.generators(pose), pose, self._pairs, variables.joints)
        if pull is not None:
            matrix[np.diag_indices_from(matrix)] += pull[variables.joints].ravel()
        return variables.matrix(matrix)

    def _pull(self, springs: FloatArray | float) -> FloatArray | None:
        """(m, 9) weights of half the squared strains; None where there are none."""
        stiffness = np.broadcast_to(self.regularise + np.asarray(springs), self._rest.shape)
        share = float(self.weights.sum()) / max(9 * int((~self.weightless).sum()), 1)
        return share * stiffness * self._levers**2 if stiffness.any() else None

    def _strain(self, coefficients: FloatArray) -> FloatArray:
        """(m, 9) how far coefficients are from rest, in stage units."""
        return np.asarray((coefficients - self._rest) * self._levers)


def _nearer(one: Fitted, other: Fitted) -> Fitted:
    return other if other.largest < one.largest else one
