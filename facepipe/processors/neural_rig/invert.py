"""Controls of a neural rig for points: the document's inverse optimisation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.threads import one_thread
from facepipe.processors.neural_rig.inverse_data import ShapeData, SkinnedData
from facepipe.processors.neural_rig.inverse_frames import Frames
from facepipe.processors.neural_rig.inverse_report import InverseReport, told
from facepipe.processors.neural_rig.options import InvertNeuralRigOptions
from facepipe.rig.neural_rig import NeuralRig, from_default, values_of, with_orthonormal_shapes


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
            data = SkinnedData(rig, points, self.options.points) if rig.bones else ShapeData.of(rig, points)
            if self.options.mode == "adam":
                x, steps = self._adam(rig, points, first, done)
            else:
                x, steps = Frames(rig=rig, data=data, options=self.options).settled(len(points), first, blocks, done)
            seconds = time.perf_counter() - begun
            values = values_of(rig.controls, x)
            return InvertedMotion(values=values, report=self._report(rig, data, points, x, steps, seconds))

    def calls(self, frames: int) -> int:
        """How often `done` is called: for each frame, or for each step of Adam."""
        return self.options.adam_steps if self.options.mode == "adam" else frames

    def _adam(
        self, rig: NeuralRig, points: FloatArray, start: FloatArray | None, done: Callable[[], object]
    ) -> tuple[FloatArray, float]:
        from facepipe.learn.neural_inverse import descend

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
            controls=told(names, matrices, np.maximum(rms, self.options.accuracy_mm), outputs),
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
