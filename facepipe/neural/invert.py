"""Controls of a neural rig for points: the document's inverse optimisation."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.neural.inverse_frames import Frames, ShapeData, SkinnedData
from facepipe.neural.options import InvertNeuralRigOptions
from facepipe.rig.neural_rig import NeuralRig, from_default, share_limits, values_of, with_orthonormal_shapes

_RIDGE = 1e-12  # of the trace: what has no answer has a small one
_DECIMALS = 9  # of shares of ranges: steps end long before, and what comes after is of the order of sums
_ANYWHERE = 1.0 / np.sqrt(12.0)  # standard deviation of a control that may be anywhere in its range


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
        _check(rig, points, start, blocks)
        first = None if start is None else from_default(rig.controls, np.asarray(start, dtype=np.float64))
        with one_thread():
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
        matrices = np.stack([data.normal(x[[one]], np.array([one]))[1][0] for one in range(len(x))]) / 2.0
        rms = np.sqrt(np.square(off).mean(axis=1))
        means = off.mean(axis=1)
        names = [control.name for control in rig.controls]
        outputs = len(rig.shapes) + len(rig.channels)
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
            controls=_control_reports(names, matrices, np.maximum(rms, self.options.accuracy_mm), outputs),
        )


def _check(rig: NeuralRig, points: FloatArray, start: FloatArray | None, blocks: IntArray | None) -> None:
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


def _control_reports(names: list[str], matrices: FloatArray, off: FloatArray, outputs: int) -> dict[str, ControlReport]:
    """What is known of controls where points are off by `off` (f,) mm RMS.

    The standard error is that of least squares, what is left being spread evenly over all that the rig can do.

    :param matrices: (f, c, c) mean over the points of products of their derivatives, mm^2
    :param outputs: of the rig
    """
    count = len(names)
    sizes = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 0.0))
    ridge = _RIDGE * np.maximum(np.trace(matrices, axis1=1, axis2=2), 1e-30)
    inverse = np.linalg.inv(matrices + ridge[:, None, None] * np.eye(count))
    own_sizes = np.minimum(1.0 / np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)), sizes)
    free = np.sqrt(max(outputs - count, 1))
    std = np.minimum(off[:, None] / np.maximum(free * own_sizes, 1e-30), _ANYWHERE)
    shares = own_sizes / np.maximum(sizes, 1e-30)
    rows = zip(*(np.median(one, axis=0).tolist() for one in (sizes, shares, std)), strict=True)
    return {
        name: ControlReport(moves_mm=moves, own_share=share, std=error, identifiable=bool(error < 0.99 * _ANYWHERE))
        for name, (moves, share, error) in zip(names, rows, strict=True)
    }
