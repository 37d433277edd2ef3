"""Stage one: sliders, expressions and cameras from landmarks alone.

The solver is a bounded Levenberg-Marquardt: damped Gauss-Newton steps that solve their quadratic model within bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.geometry.bounded_least_squares import BoxedQuadratic
from facepipe.geometry.landmarks import face_size
from facepipe.photo.descent.landmark_rig import CONTOUR, COUNT, LandmarkRig, landmark_points
from facepipe.photo.descent.subject import FOCAL, NUMBERS, PoseSpace, Subject

_ALONG = 0.15  # weight of a contour point's error along the contour: it slides
# Landmarks on either rim of the lids and of the lips, and how well their distance is known, of the size of the face:
# better than where they are, since what misplaces one misplaces the other too.
_UPPER, _LOWER = [37, 38, 43, 44, 61, 62, 63], [41, 40, 47, 46, 67, 66, 65]
_OPENING = 0.006
HUBER = 3.0  # standard deviations beyond which an error counts linearly
_LEAST, _LARGEST = 1e-8, 1e8  # damping, of the curvature
_STEP = 1e-7  # of differences
_EDGE = 0.02  # of a slider's range, below which its L1 norm is rounded off
_ROUNDS = 3  # of reweighting
_LEAST_CONFIDENCE = 1e-6


def standardised(marks: Tensor, outward: Tensor, targets: FloatArray, sigma: FloatArray) -> Tensor:
    """(..., l + 7, 2) how far landmarks are off targets, in standard deviations: the contour's across it and, weakly,
    along it; last the openings of lids and lips.

    In pixels: `marks` (..., l, 2), directions `outward` (..., 17, 2) across the contour, targets (l, 2), sigma (l, 1).
    """
    off = marks - torch.as_tensor(targets)
    doubt = np.maximum(sigma[_UPPER], sigma[_LOWER]) * np.sqrt((1 / sigma**2).mean())  # 1: as landmarks usually count
    opening = off[..., _UPPER, :] - off[..., _LOWER, :]
    opening = opening / torch.as_tensor(_OPENING * face_size(targets[:COUNT]) * doubt)
    off = off / torch.as_tensor(sigma)
    on = off[..., CONTOUR, :]
    along = torch.stack([-outward[..., 1], outward[..., 0]], dim=-1)
    contour = torch.stack([(on * outward).sum(dim=-1), _ALONG * (on * along).sum(dim=-1)], dim=-1)
    return torch.cat([contour, off[..., CONTOUR.stop :, :], opening], dim=-2)


def huber(residuals: Tensor) -> Tensor:
    """Half the squares of residuals in standard deviations, growing linearly beyond `HUBER`."""
    size = residuals.abs()
    return torch.where(size <= HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))


@dataclass(frozen=True, kw_only=True)
class Quadratic:
    """A model of the cost around a point: ``cost + gradient d + 1/2 d^T hessian d``."""

    cost: float
    gradient: FloatArray  # (n,)
    hessian: FloatArray  # (n, n) positive semidefinite


@dataclass(frozen=True, kw_only=True)
class Minimum:
    """Where the steps ended."""

    x: FloatArray  # (n,)
    cost: float
    steps: int
    settled: bool  # the last step lowered the cost by less than the tolerance


def levenberg_marquardt(
    model: Callable[[FloatArray], Quadratic],
    cost: Callable[[FloatArray], float],
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    *,
    steps: int = 40,
    tolerance: float = 1e-4,
) -> Minimum:
    """The minimum of a cost near `start`, within bounds.

    Damping multiplies the diagonal of the Hessian (Marquardt) and follows the ratio of what a step gained to what its
    model promised (Nielsen). Nocedal and Wright, "Numerical Optimization", section 10.3, bounds by projected Newton
    steps on the model.

    :param tolerance: share of the cost; a step that gains less is the last
    """
    x = np.clip(start, lower, upper)
    here = model(x)
    damping, growth = 1e-3, 2.0
    for number in range(steps):
        # what moves no landmark has a diagonal of 0, which no damping would lift: the model would stay singular
        diagonal = np.maximum(np.diag(here.hessian), 1e-9 * max(float(np.diag(here.hessian).max()), 1e-30))
        damped = BoxedQuadratic(here.hessian + np.diag(damping * diagonal))
        d = damped.minimise(here.gradient, lower - x, upper - x)
        promised = -float(here.gradient @ d + 0.5 * d @ here.hessian @ d)
        tried = np.clip(x + d, lower, upper)
        gained = here.cost - cost(tried)
        if gained > 0 and promised > 0:
            x, before = tried, here.cost
            here = model(x)
            damping = float(np.clip(damping * max(1 / 3, 1 - (2 * gained / promised - 1) ** 3), _LEAST, _LARGEST))
            growth = 2.0
            if gained <= tolerance * before:
                return Minimum(x=x, cost=here.cost, steps=number + 1, settled=True)
        elif promised <= tolerance * tolerance * abs(here.cost) or damping >= _LARGEST:
            return Minimum(x=x, cost=here.cost, steps=number + 1, settled=True)
        else:
            damping, growth = min(damping * growth, _LARGEST), 2 * growth
    return Minimum(x=x, cost=here.cost, steps=steps, settled=False)


@dataclass(frozen=True, kw_only=True)
class Priors:
    """What is likely before any photo is seen."""

    landmark_sigma: float = 0.02  # standard deviation of landmarks, of the size of the face
    slider_sigma: float = 0.2  # of sliders around their defaults, of their range
    slider_sparsity: float = 0.0  # L1 weight of sliders, per range
    expression_sparsity: float = 3.0  # L1 weight of expressions
    focal_sigma: float = 0.2  # of the logarithm of the focal length


@dataclass(frozen=True, kw_only=True)
class State:
    """What is sought: shares 0..1 of the free sliders' ranges, expressions 0..1 and poses of the photos."""

    shares: FloatArray  # (f,)
    expressions: FloatArray  # (v, e)
    poses: FloatArray  # (v, 7) as `PoseSpace`

    def vector(self) -> FloatArray:
        """All in one: shares, then expressions and pose photo by photo."""
        return np.concatenate([self.shares, np.concatenate([self.expressions, self.poses], axis=1).ravel()])

    def from_vector(self, vector: FloatArray) -> State:
        """The state of this shape that a vector stands for."""
        views, expressions = self.expressions.shape
        rest = vector[len(self.shares) :].reshape(views, expressions + NUMBERS)
        return State(shares=vector[: len(self.shares)], expressions=rest[:, :expressions], poses=rest[:, expressions:])


class LandmarkFit:
    """The landmark problem of one face and some photos of one person."""

    def __init__(
        self,
        subject: Subject,
        targets: Sequence[FloatArray],
        spaces: Sequence[PoseSpace],
        priors: Priors,
        rig: LandmarkRig | None = None,
        confidences: Sequence[FloatArray] | None = None,
    ) -> None:
        """
        :param targets: (68, 2) landmarks of each photo, pixels, or (68 + d, 2) with those of the scheme ``dense``
        :param confidences: of each photo's, 0 to 1: what squared errors count beside each other; None: alike
        :param rig: of the subject, where there is one already
        :raises InputError: the face lacks the 68 landmarks
        """
        self.subject, self.spaces, self.priors = subject, tuple(spaces), priors
        self.targets = [np.asarray(each, dtype=np.float64) for each in targets]
        dense = any(len(each) > COUNT for each in self.targets)
        self.rig = LandmarkRig.from_subject(subject, dense=dense) if rig is None else rig
        every = [np.ones(len(each)) for each in self.targets] if confidences is None else confidences
        trusts = [np.maximum(each, _LEAST_CONFIDENCE) for each in every]
        self.sigma = [  # (l, 1) pixels; landmarks count the same in all, whatever the confidences
            priors.landmark_sigma
            * face_size(each[:COUNT])
            * np.sqrt(float(np.sqrt(len(each) / COUNT)) * trust.mean() / trust)[:, None]
            for each, trust in zip(self.targets, trusts, strict=True)
        ]

    def start(self) -> State:
        """Defaults, no expression, and the poses that this gives."""
        rig = self.subject.rig
        points, _ = landmark_points(self.subject.parts)
        world = rig.points[points] @ rig.parent_world[:3, :3].T + rig.parent_world[:3, 3]
        inner = slice(CONTOUR.stop, COUNT)
        poses = [
            space.guess(world[inner], target[inner]) for space, target in zip(self.spaces, self.targets, strict=True)
        ]
        views = len(poses)
        return State(
            shares=self.subject.default_shares,
            expressions=np.zeros((views, len(self.subject.expressions))),
            poses=np.stack(poses),
        )

    def solve(self, start: State, *, steps: int = 30) -> State:
        """The likeliest state near `start`: pose first, then all."""
        template = start
        none = replace(template, shares=0 * template.shares, expressions=0 * template.expressions)
        free = np.full_like(template.poses, np.inf)
        lower = replace(none, poses=-free).vector()
        upper = replace(none, shares=none.shares + 1, expressions=none.expressions + 1, poses=free).vector()
        x = np.clip(start.vector(), lower, upper)
        held = np.ones(len(x), dtype=np.bool_)
        held[self._pose_numbers(template)] = False
        x = self._minimise(template, x, np.where(held, x, lower), np.where(held, x, upper), steps).x
        for _ in range(_ROUNDS):
            x = self._minimise(template, x, lower, upper, steps).x
        return template.from_vector(x)

    def landmarks(self, state: State) -> FloatArray:
        """(v, 68, 2) pixels of the face's landmarks in each photo."""
        return np.stack([self._project(i, own[None])[0][0, :COUNT] for i, own in enumerate(self._own(state))])

    def errors(self, state: State) -> FloatArray:
        """(v, 68) distances to the targets, pixels; contour points across the contour."""
        result = []
        for view, own in enumerate(self._own(state)):
            marks, outward = self._project(view, own[None])
            off = (marks[0] - self.targets[view])[:COUNT]
            distance = np.linalg.norm(off, axis=1)
            distance[CONTOUR] = np.abs((off[CONTOUR] * outward[0]).sum(axis=1))
            result.append(distance)
        return np.stack(result)

    def _minimise(self, template: State, x: FloatArray, lower: FloatArray, upper: FloatArray, steps: int) -> Minimum:
        weights = 1 / np.maximum(np.abs(x[: len(template.shares)] - self.subject.default_shares), _EDGE)
        return levenberg_marquardt(
            lambda at: self._model(template.from_vector(at), weights),
            lambda at: self._cost(template.from_vector(at), weights),
            x,
            lower,
            upper,
            steps=steps,
        )

    def _pose_numbers(self, state: State) -> BoolArray:
        zero = replace(state, shares=0 * state.shares, expressions=0 * state.expressions, poses=0 * state.poses + 1)
        return np.asarray(zero.vector() == 1)

    def _own(self, state: State) -> list[FloatArray]:
        """By photo, all that it depends on: shares, expressions, pose."""
        return [np.concatenate([state.shares, *pair]) for pair in zip(state.expressions, state.poses, strict=True)]

    def _project(self, view: int, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Landmarks (k, l, 2) and outward directions (k, 17, 2) of k rows of what one photo depends on."""
        f, e = len(self.subject.sliders), len(self.subject.expressions)
        with torch.no_grad():
            sliders = torch.as_tensor(self.subject.slider_values(numbers[:, :f]))
            weights = torch.as_tensor(self.subject.shape_weights(numbers[:, f : f + e]))
            points = self.rig.rig(sliders, weights if len(self.subject.rig.shapes) else None)
            camera = self.spaces[view].camera(torch.as_tensor(numbers[:, f + e :]))
            marks, outward = self.rig.landmarks(points, camera)
        return marks[:, : len(self.targets[view])].numpy(), outward.numpy()

    def _residuals(self, view: int, numbers: FloatArray) -> FloatArray:
        """(k, r) errors of k rows in standard deviations, as `standardised` has them."""
        marks, outward = self._project(view, numbers)
        off = standardised(torch.as_tensor(marks), torch.as_tensor(outward), self.targets[view], self.sigma[view])
        return np.asarray(off.numpy().reshape(len(numbers), -1))

    def _cost(self, state: State, weights: FloatArray) -> float:
        total = sum(_cost(self._residuals(view, own[None])[0]) for view, own in enumerate(self._own(state)))
        return total + self._prior(state, weights)[0]

    def _model(self, state: State, weights: FloatArray) -> Quadratic:
        cost, gradient, hessian = self._prior(state, weights)
        f = len(state.shares)
        width = state.expressions.shape[1] + NUMBERS
        for view, numbers in enumerate(self._own(state)):
            bounded = len(numbers) - NUMBERS
            # (n,) steps ahead, of numbers among the first `bounded` that would leave 0..1 back: beyond, all is flat
            steps = np.full(len(numbers), _STEP)
            steps[:bounded][numbers[:bounded] + _STEP > 1] *= -1
            values = self._residuals(view, np.concatenate([numbers[None], numbers + np.diag(steps)]))
            jacobian = (values[1:] - values[0]).T / steps
            slope = np.clip(values[0], -HUBER, HUBER)
            scale = np.where(np.abs(values[0]) > HUBER, HUBER / np.maximum(np.abs(values[0]), HUBER), 1.0)
            place = np.concatenate([np.arange(f), f + view * width + np.arange(width)])
            gradient[place] += jacobian.T @ slope
            hessian[np.ix_(place, place)] += jacobian.T @ (scale[:, None] * jacobian)
            cost += _cost(values[0])
        return Quadratic(cost=cost, gradient=gradient, hessian=hessian)

    def _prior(self, state: State, weights: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Cost, gradient and Hessian of what is likely without photos."""
        priors = self.priors
        off = state.shares - self.subject.default_shares
        pull = 1 / priors.slider_sigma**2 + priors.slider_sparsity * weights
        focal = np.array([space.log_focal(pose) for space, pose in zip(self.spaces, state.poses, strict=True)])
        focal = (focal - np.log(FOCAL)) / priors.focal_sigma
        slope = np.zeros_like(state.poses)
        slope[:, 5:] = focal[:, None] / priors.focal_sigma
        gradient = State(
            shares=pull * off, expressions=np.full_like(state.expressions, priors.expression_sparsity), poses=slope
        ).vector()
        cost = 0.5 * float(pull @ off**2) + priors.expression_sparsity * float(state.expressions.sum())
        hessian = np.diag(State(shares=pull, expressions=0 * state.expressions, poses=0 * state.poses).vector())
        last = np.flatnonzero(self._pose_numbers(state)).reshape(-1, NUMBERS)[:, 5:]
        for pair in last:
            # log focal length is the sum of both numbers: its Hessian is a full block of rank 1, no diagonal
            hessian[np.ix_(pair, pair)] += 1 / priors.focal_sigma**2
        return cost + 0.5 * float(focal @ focal), gradient, hessian


def _cost(residuals: FloatArray) -> float:
    return float(huber(torch.as_tensor(residuals)).sum())
