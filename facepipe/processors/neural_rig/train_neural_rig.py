"""Train a neural rig: controls to deformation, the forward part of the document's first submodel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.geometry.motion_basis import motion_basis
from facepipe.options import check_ranges
from facepipe.processors.neural_rig.motion import Motion
from facepipe.reports import Report
from facepipe.rig.neural_rig import NeuralRig, inputs

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class TrainNeuralRigOptions:
    """How a neural rig is trained.

    :raises InputError: a number out of range
    """

    width: int = field(default=128, metadata={"help": "units of the hidden layer", "range": (1, 4096)})
    shapes: int = field(default=128, metadata={"help": "most shapes that motion is a sum of", "range": (1, 2048)})
    tolerance_mm: float = field(
        default=0.01,
        metadata={"help": "what those shapes may leave of all frames, RMS", "unit": "mm", "range": (0.0, 10.0)},
    )
    held_out: float = field(
        default=0.15, metadata={"help": "share of the frames to check on, in whole blocks", "range": (0.01, 0.9)}
    )
    steps: int = field(default=6000, metadata={"help": "most steps of training", "range": (1, 1e7)})
    patience: int = field(
        default=1000, metadata={"help": "steps without a better check that end it", "range": (1, 1e7)}
    )
    seed: int = field(default=0, metadata={"help": "of the split, the network and the batches", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class NeuralRigReport(Report):
    """How near a neural rig comes to frames that it was not trained on, in millimetres."""

    frames: int
    held_out: int
    shapes: int
    steps: int
    motion_mean_mm: float  # of the held-out frames, from rest
    error_mean_mm: float
    error_max_mm: float
    linear_mean_mm: float  # of blendshapes, one a control, that fit the same frames best
    linear_max_mm: float
    left_out: tuple[str, ...]  # controls that no frame moves
    source: str = "rig"  # of the frames: facepipe's own rig, "rig and clips", or "samples" of a stage


@dataclass(frozen=True, kw_only=True)
class TrainedNeuralRig:
    """A neural rig, and how good it is."""

    rig: NeuralRig
    report: NeuralRigReport


@dataclass(frozen=True, kw_only=True)
class TrainNeuralRig:
    """Principal shapes of the motion, and their activations by a linear map with a layer of tanh beside it.

    Source: neural-face-rig, the first submodel's forward direction (S101, S301); the low rank and the exact linear part
    are ours.
    """

    options: TrainNeuralRigOptions = field(default_factory=TrainNeuralRigOptions)

    def __call__(self, motion: Motion, done: Callable[[], object] = lambda: None) -> TrainedNeuralRig:
        """Train on some blocks of frames, and measure on the others.

        :param done: called once for each step
        :raises InputError: no control that moves, or a single block of frames
        """
        from facepipe.learn.network_fit import Samples, train

        options, still = self.options, motion.constant
        if len(still) == len(motion.controls):
            raise InputError(motion.where, "no control moves in any frame, expected one or more that do")
        motion = motion.without(still)
        learned, checked = motion.split(options.held_out, options.seed)
        shapes, activations = motion_basis(learned.points - motion.rest, options.tolerance_mm, options.shapes)
        flat = shapes.reshape(len(shapes), -1)
        of_checked = (checked.points - motion.rest).reshape(len(checked.values), -1) @ flat.T
        trained = train(
            Samples(inputs=inputs(motion.controls, learned.values), outputs=activations),
            Samples(inputs=inputs(motion.controls, checked.values), outputs=of_checked),
            width=options.width,
            activation="tanh",
            seed=options.seed,
            steps=options.steps,
            patience=options.patience,
            done=done,
        )
        rig = NeuralRig(
            controls=motion.controls,
            rest=motion.rest,
            shapes=shapes,
            linear=trained.linear,
            hidden=trained.hidden,
            hidden_bias=trained.hidden_bias,
            last=trained.last,
            last_bias=trained.last_bias,
            topology=motion.topology.digest,
        )
        report = replace(_report(rig, learned, checked), steps=trained.steps, left_out=still)
        report = replace(report, source=motion.source, warnings=motion.warnings)
        return TrainedNeuralRig(rig=rig, report=report)


def _report(rig: NeuralRig, learned: Motion, checked: Motion) -> NeuralRigReport:
    off, linear_off, moved = [], [], []
    linear = _linear(learned)
    x = _with_one(inputs(checked.controls, checked.values))
    for row, values, points in zip(x, checked.values, checked.points, strict=True):
        off.append(np.linalg.norm(rig.points(values) - points, axis=1))
        linear_off.append(np.linalg.norm(rig.rest + (row @ linear).reshape(-1, 3) - points, axis=1))
        moved.append(np.linalg.norm(points - rig.rest, axis=1))
    return NeuralRigReport(
        frames=len(learned.values),
        held_out=len(checked.values),
        shapes=len(rig.shapes),
        steps=0,
        motion_mean_mm=float(np.mean(moved)),
        error_mean_mm=float(np.mean(off)),
        error_max_mm=float(np.max(off)),
        linear_mean_mm=float(np.mean(linear_off)),
        linear_max_mm=float(np.max(linear_off)),
        left_out=(),
    )


def _linear(motion: Motion) -> FloatArray:
    """(c + 1, 3n) least-squares blendshapes of the controls, and an offset."""
    x = _with_one(inputs(motion.controls, motion.values))
    deltas = (motion.points - motion.rest).reshape(len(x), -1)
    return np.asarray(np.linalg.lstsq(x, deltas, rcond=None)[0])


def _with_one(x: FloatArray) -> FloatArray:
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)
