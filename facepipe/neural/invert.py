"""Controls of a neural rig for points: the document's inverse optimisation, frame by frame, and how far off it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.bounded_least_squares import Box, Data, Settled, Smoothness, settle
from facepipe.neural.options import InvertNeuralRigOptions
from facepipe.rig.neural_rig import (
    NeuralRig,
    SkinnedPoints,
    from_default,
    output_derivatives,
    share_limits,
    values_of,
    with_orthonormal_shapes,
    with_points,
)

_POSES = 3  # where points are weighed, the first at rest
_BUSY_POSE = 0.3  # share of the controls that are moved in the others
_EVEN = 0.2  # share of the points that are taken evenly
_SMALL_RIDGE = 1e-6  # of the mean diagonal: what no point shows counts as little
ENOUGH = 1e-5  # of ranges: a smaller step ends it
_AT_ONCE = 64  # frames
_WINDOW = 120  # frames of a clip that are solved together; those before are known
_FEW = 8  # frames, of which none can be said to be worse than the others
_WORSE = 3.0  # times the median of the costs, by those at rest
_SAME = 0.01  # of a cost: another start that ends so near was in the same valley
_BUSY = 0.5  # share of the controls that a random start moves
_SMALL = 1e-4  # mm^2 that are no reason to start again: a hundredth of a millimetre
_STEP_RIDGE = 1e-12  # of the trace: what has no answer has a small one
_DECIMALS = 9  # of shares of ranges: steps end long before, and what comes after is of the order of sums
_ANYWHERE = 1.0 / np.sqrt(12.0)  # standard deviation of a control that may be anywhere in its range


@dataclass(frozen=True, kw_only=True)
class ShapeData:
    """Of a rig without bones: its shapes are orthonormal, so that distances of activations are those of points.

    Mean over the points of squared distances, mm^2; unknowns are shares of ranges from defaults.
    """

    rig: NeuralRig
    activations: FloatArray  # (f, r) of the shapes nearest to the targets
    left: FloatArray  # (f,) squares that no sum of shapes makes

    @classmethod
    def from_targets(cls, rig: NeuralRig, points: FloatArray) -> ShapeData:
        """Of targets (f, n, 3)."""
        shapes = rig.shapes.reshape(len(rig.shapes), -1)
        activations, squares = np.empty((len(points), len(shapes))), np.empty(len(points))
        for number, frame in enumerate(points):
            moved = (frame - rig.rest).ravel()
            activations[number] = shapes @ moved
            squares[number] = moved @ moved
        left = np.maximum(squares - np.square(activations).sum(axis=1), 0.0)
        return cls(rig=rig, activations=activations, left=left)

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        """(k,) mm^2 of (k, c)."""
        off = _outputs(self.rig, x) - self.activations[frames]
        return np.asarray((np.square(off).sum(axis=1) + self.left[frames]) / len(self.rig.rest))

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k, c) derivatives and (k, c, c) second ones, those of Gauss and Newton."""
        outputs, by_control = output_derivatives(self.rig, x)
        across, scale = np.swapaxes(by_control, 1, 2), 2.0 / len(self.rig.rest)
        off = outputs - self.activations[frames]
        return scale * (across @ off[..., None])[..., 0], scale * (across @ by_control)


class SkinnedData:
    """Of a rig with bones: distances and derivatives of all points, second derivatives of some that stand for all.

    Some are drawn by how much they say of the controls (leverage), and weighed by how rarely they are drawn.
    Source: Drineas, Mahoney and Muthukrishnan, "Sampling algorithms for l2 regression and applications", SODA 2006.
    """

    def __init__(self, rig: NeuralRig, points: FloatArray, some: int) -> None:
        """
        :param points: (f, n, 3) targets
        :param some: points for second derivatives
        """
        assert rig.bones is not None
        self.rig, self._targets = rig, points
        self._all = SkinnedPoints(rig, rig.bones)
        chosen, weights = self._chosen(some)
        own = with_points(rig, chosen)
        assert own.bones is not None
        self._some, self._weights = SkinnedPoints(own, own.bones), np.sqrt(weights)

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        """(k,) mm^2 of (k, c)."""
        costs = np.empty(len(x))
        for number, outputs in enumerate(_outputs(self.rig, x)):
            off = self.rig.deformed(outputs) - self._targets[frames[number]]
            costs[number] = np.square(off).sum() / len(off)
        return costs

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """(k, c) derivatives and (k, c, c) second ones, those of Gauss and Newton, nearly."""
        slopes, matrices = np.empty_like(x), np.empty((len(x), x.shape[1], x.shape[1]))
        scale = 2.0 / len(self.rig.rest)
        for number in range(len(x)):
            outputs, by_control = (
                output_derivative[0] for output_derivative in output_derivatives(self.rig, x[number : number + 1])
            )
            off = self.rig.deformed(outputs) - self._targets[frames[number]]
            slopes[number] = scale * by_control.T @ self._all.gradient(outputs, off)
            by_point = self._some.derivatives(outputs) * self._weights
            moved = by_control.T @ by_point.reshape(len(by_point), -1)
            matrices[number] = scale * (moved @ moved.T)
        return slopes, matrices

    def _chosen(self, some: int) -> tuple[IntArray, FloatArray]:
        """Points, and for how many each counts."""
        count = len(self.rig.rest)
        if count <= some:
            return np.arange(count), np.ones(count)
        shares = np.full(count, _EVEN / count)
        ends, controls = share_limits(self.rig.controls), len(self.rig.controls)
        random = np.random.default_rng(0)
        for pose in range(_POSES):
            x = random.uniform(*ends) * (random.random(controls) < (_BUSY_POSE if pose else 0.0))
            outputs, by_control = (output_derivative[0] for output_derivative in output_derivatives(self.rig, x[None]))
            moved = (by_control.T @ self._all.derivatives(outputs).reshape(len(outputs), -1)).reshape(len(x), 3, -1)
            # leverage: the points' shares in what is known of the controls
            flat = moved.reshape(len(moved), -1)
            matrix = flat @ flat.T
            matrix += _SMALL_RIDGE * max(float(np.trace(matrix)) / len(matrix), 1e-30) * np.eye(len(matrix))
            shown = (flat * np.linalg.solve(matrix, flat)).sum(axis=0).reshape(3, -1).sum(axis=0)
            shares += (1.0 - _EVEN) / _POSES * np.asarray(shown / max(float(shown.sum()), 1e-30))
        places = (np.arange(some) + 0.5) / some * shares.sum()
        chosen, times = np.unique(np.searchsorted(np.cumsum(shares), places), return_counts=True)
        return chosen, times * shares.sum() / (some * shares[chosen])


def _outputs(rig: NeuralRig, x: FloatArray) -> FloatArray:
    from scipy.special import expit

    units = x @ rig.hidden.T + rig.hidden_bias
    return np.asarray(x @ rig.linear + (units * expit(units)) @ rig.last.T + rig.last_bias)


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Targets, and what is asked of their controls; x is how far these are from defaults, in shares of ranges."""

    rig: NeuralRig
    data: Data
    options: InvertNeuralRigOptions

    def settled(
        self, count: int, start: FloatArray | None, blocks: IntArray | None, done: Callable[[], object]
    ) -> tuple[FloatArray, float]:
        """(f, c) x, and the mean number of steps.

        :param count: of frames
        :param done: called once for each frame
        """
        rest = np.zeros((count, len(self.box.lower)))
        settled = self._each(rest if start is None else start, np.arange(count), done)
        random, again = np.random.default_rng(self.options.seed), np.arange(count)
        still = self.data.cost(rest, again)
        for attempt in range(1, self.options.starts):
            share = settled.cost / np.maximum(still, 1e-30)
            usual = _WORSE * float(np.median(share)) if len(settled.cost) >= _FEW else 0.0
            again = np.intersect1d(again, np.flatnonzero((share > usual) & (settled.cost > _SMALL)))
            shape = (len(again), rest.shape[1])
            other: FloatArray = random.uniform(self.box.lower, self.box.upper, shape) * (random.random(shape) < _BUSY)
            good = np.setdiff1d(np.arange(count), again)
            if attempt == 1 and start is not None:
                other = rest[again]
            elif attempt == 1 and blocks is not None and len(good):  # of each the nearest of those that are good
                other = settled.x[good[np.abs(good[None, :] - again[:, None]).argmin(axis=1)]]
            tried = self._each(other, again)
            # Two starts that end at one cost are taken to have found the minimum: only other frames are tried again.
            apart = np.abs(tried.cost - settled.cost[again]) > _SAME * settled.cost[again]
            better = tried.cost < settled.cost[again]  # steps of both count
            x, cost, steps = settled.x.copy(), settled.cost.copy(), settled.steps.copy()
            x[again[better]], cost[again[better]] = tried.x[better], tried.cost[better]
            steps[again] += tried.steps
            settled, again = Settled(x=x, cost=cost, steps=steps), again[apart]
        if blocks is None or self.options.smoothness == 0.0:
            return settled.x, float(settled.steps.mean())
        x, steps = settled.x, settled.steps
        for clip in np.split(np.arange(count), np.flatnonzero(np.diff(np.asarray(blocks))) + 1):
            for first in range(0, len(clip), _WINDOW):  # together, after the two known ones before them
                rows, before = clip[first : first + _WINDOW], clip[max(first - 2, 0) : first]
                found = self._settle(x[rows], rows, Smoothness(weight=self.options.smoothness, before=x[before]))
                x[rows] = found.x
                steps[rows] += found.steps
        return x, float(steps.mean())

    @cached_property
    def box(self) -> Box:
        """Limits of x."""
        lower, upper = share_limits(self.rig.controls)
        return Box(lower=lower, upper=upper, l1=self.options.l1)

    def _each(self, start: FloatArray, frames: IntArray, done: Callable[[], object] = lambda: None) -> Settled:
        """Each on its own."""
        batches = []
        for first in range(0, len(frames), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            batches.append(self._settle(start[rows], frames[rows]))
            for _ in frames[rows]:
                done()
        if not batches:
            return Settled(x=start, cost=np.zeros(0), steps=np.zeros(0, np.int64))
        return Settled(
            x=np.concatenate([batch.x for batch in batches]),
            cost=np.concatenate([batch.cost for batch in batches]),
            steps=np.concatenate([batch.steps for batch in batches]),
        )

    def _settle(self, start: FloatArray, frames: IntArray, smoothness: Smoothness | None = None) -> Settled:
        data = _Some(data=self.data, frames=frames)
        return settle(data, start, self.box, smoothness=smoothness, steps=self.options.steps, enough=ENOUGH)


@dataclass(frozen=True, kw_only=True)
class _Some:
    """The data of some frames, by their numbers among themselves."""

    data: Data
    frames: IntArray

    def cost(self, x: FloatArray, frames: IntArray) -> FloatArray:
        return self.data.cost(x, self.frames[frames])

    def normal(self, x: FloatArray, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        return self.data.normal(x, self.frames[frames])


@dataclass(frozen=True, kw_only=True)
class InvertedMotion:
    """Controls, and how near their points come."""

    values: FloatArray  # (f, c) in the controls' own units, within their limits
    report: InverseReport


@dataclass(frozen=True, kw_only=True)
class InvertNeuralRig:
    """Controls within limits whose points are nearest to targets: mean squared distance over all points, with a small
    price on controls away from their defaults, and in clips on changes of speed.

    Source: neural-face-rig, S301-S303: random controls, forward through the frozen submodel, distances point by point,
    Adam; that is mode adam. Mode lm is ours: Levenberg-Marquardt within limits, L1 and smoothness.
    """

    options: InvertNeuralRigOptions = field(default_factory=InvertNeuralRigOptions)

    def __call__(
        self,
        rig: NeuralRig,
        points: FloatArray,
        start: FloatArray | None = None,
        blocks: IntArray | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> InvertedMotion:
        """Of frames on the rig's topology.

        :param points: (f, n, 3) millimetres
        :param start: (f, c) values to start from, an encoder's; held within limits
        :param blocks: (f,) frames of one number next to one another are of one clip; None: no frame follows another
        :param done: called `calls(f)` times
        :raises TopologyError: another number of points
        :raises InputError: no frames, NaN, or starts or blocks of another shape
        """
        begun = time.perf_counter()
        points = np.asarray(points)
        where, count = "target points", len(rig.rest)
        if points.ndim != 3 or points.shape[1:] != (count, 3):
            raise TopologyError(where, f"shape {points.shape}, expected (frames, {count}, 3) as the rig has")
        if not len(points):
            raise InputError(where, "no frames, expected one or more")
        bad = next((number for number, own in enumerate(points) if not np.isfinite(own).all()), None)
        if bad is not None:
            raise InputError(f"{where} -> frame {bad}", "NaN or infinity, expected finite numbers")
        shape = (len(points), len(rig.controls))
        if start is not None and (np.shape(start) != shape or not np.isfinite(start).all()):
            raise InputError("start", f"shape {np.shape(start)}, expected {shape} finite numbers")
        if blocks is not None and np.shape(blocks) != shape[:1]:
            raise InputError("blocks", f"shape {np.shape(blocks)}, expected {shape[:1]}: one for each frame")
        first = None if start is None else from_default(rig.controls, np.asarray(start, dtype=np.float64))
        with one_thread():
            # Of orthonormal shapes, distances of activations are those of points.
            rig = rig if rig.bones else with_orthonormal_shapes(rig)
            data = SkinnedData(rig, points, self.options.points) if rig.bones else ShapeData.from_targets(rig, points)
            if self.options.mode == "adam":
                x, steps = self._adam(rig, points, first, done)
            else:
                x, steps = Frames(rig=rig, data=data, options=self.options).settled(len(points), first, blocks, done)
            x = np.clip(np.round(x, _DECIMALS), *share_limits(rig.controls))
            seconds = time.perf_counter() - begun
            values = values_of(rig.controls, x)
            return InvertedMotion(values=values, report=self._report(rig, data, points, x, steps, seconds))

    def calls(self, frames: int) -> int:
        """How often `done` is called: for each frame, or for each step of Adam."""
        return self.options.adam_steps if self.options.mode == "adam" else frames

    def _adam(
        self, rig: NeuralRig, points: FloatArray, start: FloatArray | None, done: Callable[[], object]
    ) -> tuple[FloatArray, float]:
        from facepipe.neural.learning.neural_inverse import descend

        options = self.options
        x = descend(
            rig,
            points,
            start,
            steps=options.adam_steps,
            rate=options.adam_rate,
            l1=options.l1,
            seed=options.seed,
            done=done,
        )
        return x, float(options.adam_steps)

    def _report(
        self,
        rig: NeuralRig,
        data: ShapeData | SkinnedData,
        points: FloatArray,
        x: FloatArray,
        steps: float,
        seconds: float,
    ) -> InverseReport:
        values = values_of(rig.controls, x)
        off = np.stack([np.linalg.norm(rig.points(row) - own, axis=1) for row, own in zip(values, points, strict=True)])
        # Halved: second derivatives of a mean of squares are 2 J^T J / n.
        matrices = np.stack([data.normal(x[[one]], np.array([one]))[1][0] for one in range(len(x))]) / 2.0
        rms = np.sqrt(np.square(off).mean(axis=1))
        means = off.mean(axis=1)
        # the standard error is that of least squares, what is left being spread evenly over all that the rig can do
        sizes = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 0.0))
        ridge = _STEP_RIDGE * np.maximum(np.trace(matrices, axis1=1, axis2=2), 1e-30)
        inverse = np.linalg.inv(matrices + ridge[:, None, None] * np.eye(len(rig.controls)))
        # 1 / sqrt((J^T J)^-1_kk) is what of a control's motion no others together can make
        own_sizes = np.minimum(1.0 / np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)), sizes)
        free = np.sqrt(max(len(rig.shapes) + len(rig.channels) - len(rig.controls), 1))
        doubt = np.maximum(rms, self.options.accuracy_mm)[:, None]
        std = np.minimum(doubt / np.maximum(free * own_sizes, 1e-30), _ANYWHERE)
        shares = own_sizes / np.maximum(sizes, 1e-30)
        rows = zip(*(np.median(one, axis=0).tolist() for one in (sizes, shares, std)), strict=True)
        return InverseReport(
            mode=self.options.mode,
            frames=len(points),
            error_mean_mm=float(off.mean()),
            error_rms_mm=float(np.sqrt(np.square(off).mean())),
            error_p95_mm=float(np.quantile(off, 0.95)),
            error_max_mm=float(off.max()),
            worst_frame=int(means.argmax()),
            worst_frame_mm=float(means.max()),
            steps=steps,
            seconds=seconds,
            seconds_per_frame=seconds / len(points),
            controls={
                control.name: ControlReport(
                    moves_mm=moves, own_share=share, std=error, identifiable=bool(error < 0.99 * _ANYWHERE)
                )
                for control, (moves, share, error) in zip(rig.controls, rows, strict=True)
            },
        )


@dataclass(frozen=True, kw_only=True)
class ControlReport:
    """How well targets determine one control, in the median of the frames."""

    moves_mm: float  # RMS over all points of what it does, over its whole range
    own_share: float  # 0..1 of that which no others together can do
    std: float  # standard error as a share of its range, at most 0.29: it may be anywhere
    identifiable: bool


@dataclass(frozen=True, kw_only=True)
class InverseReport(Report):
    """How near points come to targets, in millimetres over all points and frames, and what it took."""

    mode: str
    frames: int
    error_mean_mm: float
    error_rms_mm: float
    error_p95_mm: float
    error_max_mm: float
    worst_frame: int  # of the largest mean error
    worst_frame_mm: float
    steps: float  # mean of the frames
    seconds: float
    seconds_per_frame: float
    controls: Mapping[str, ControlReport]

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Controls that may be anywhere, for all that the targets show."""
        return tuple(name for name, one in self.controls.items() if not one.identifiable)
