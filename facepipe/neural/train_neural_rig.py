"""Train a neural rig: controls to deformation, the forward part of the document's first submodel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report, not_in_json
from facepipe.core.threads import one_thread
from facepipe.neural.checkpoint import Checkpoint
from facepipe.neural.motion import Motion
from facepipe.neural.options import TrainNeuralRigOptions
from facepipe.neural.output_basis import OutputBasis
from facepipe.neural.straight_models import Straight, best_blendshapes, ridge, straight_rig
from facepipe.rig.neural_rig import NeuralRig, from_default, with_influences

if TYPE_CHECKING:
    from facepipe.neural.train_encoder import EncoderReport
    from facepipe.rig.torch.network_fit import Samples, Trained


_WATCHED = 0.1  # of the frames to learn
_STRAIGHT_MM = 1e-3  # more than blendshapes may be off where there is nothing to learn beside them


@dataclass(frozen=True, kw_only=True)
class NeuralRigReport(Report):
    """How near a neural rig comes to frames that it was not trained on, in millimetres."""

    frames: int
    held_out: int
    between: int  # other frames, left out where clips were cut into blocks
    shapes: int
    channels: int  # of bones that move
    steps: int
    motion_mean_mm: float  # of the held-out frames, from rest
    error_mean_mm: float
    error_max_mm: float
    linear_mean_mm: float  # of blendshapes, one a control, that fit the same frames best
    linear_max_mm: float
    ridge_mean_mm: float  # of ridge regression to principal components
    ridge_max_mm: float
    left_out: tuple[str, ...]  # controls that no frame moves
    source: str = "rig"  # of the frames: facepipe's own rig, "rig and clips", or "samples" of a stage
    encoder: EncoderReport | None = None  # of the encoder that was trained beside it
    curve: Any = not_in_json()  # that of `TrainedNeuralRig`, to be drawn

    @property
    def straight(self) -> bool:
        """Whether blendshapes, one a control, are all of the rig, so that nothing was learned."""
        return self.linear_max_mm <= _STRAIGHT_MM


@dataclass(frozen=True, kw_only=True)
class TrainedNeuralRig:
    """A neural rig, and how good it is."""

    rig: NeuralRig
    report: NeuralRigReport
    curve: FloatArray  # (checks, 3): step, and what is left of learned and of watched frames, RMS in shares of all


@dataclass(frozen=True, kw_only=True)
class TrainNeuralRig:
    """Bones as they are known, principal shapes of what they leave of the motion, and coefficients and activations by a
    linear map with a layer of sparse units beside it. Where blendshapes, one a control, miss no point of the frames
    held out by more than 0.001 mm, there is no such layer: the linear map is solved for, and the report warns.

    Source: neural-face-rig, the first submodel's forward direction (S101, S301); bones, low rank, the exact linear part
    and sparse units are ours.
    """

    options: TrainNeuralRigOptions = field(default_factory=TrainNeuralRigOptions)

    @one_thread()
    def __call__(
        self, motion: Motion, done: Callable[[], object] = lambda: None, checkpoint: Path | None = None
    ) -> TrainedNeuralRig:
        """Train on some blocks of frames, and measure on the others; on a GPU where torch has one.

        :param done: called once for each step
        :param checkpoint: a file that records now and then where the training stands, and in the end that it has ended;
            it goes on from there if it is there, and gives the same. Whoever is done with it removes it
        :raises InputError: no control that moves, a single block of frames, or a checkpoint of another training
        """
        from facepipe.rig.torch.network_fit import train
        from facepipe.rig.torch.one_thread import best_device

        options, still = self.options, motion.constant
        if motion.bones is not None and options.influences:
            motion = replace(motion, bones=with_influences(motion.bones, options.influences))
        if len(still) == len(motion.controls):
            raise InputError(motion.where, "no control moves in any frame, expected one or more that do")
        learned, checked = motion.without(still).split(options.held_out, options.seed)
        straight = best_blendshapes(learned)
        if _largest_mm(straight, checked) <= _STRAIGHT_MM:
            return self._straight(motion, learned, checked, straight)
        kept = Checkpoint.for_training(checkpoint, "rig", motion, options) if checkpoint else None
        taught, watched = _watched(learned, options)
        basis = OutputBasis.from_motion(taught, options.tolerance_mm, options.shapes, options.detail)
        trained = train(
            _samples(taught, basis),
            _samples(watched, basis),
            width=options.width,
            activation="silu",
            seed=options.seed,
            steps=options.steps,
            patience=options.patience,
            sparsity=options.sparsity,
            device=best_device(),
            done=done,
            state=kept.state() if kept else None,
            keep=kept.keep if kept else lambda _: None,
        )
        rig = _assembled(learned, basis, trained)
        report = replace(_report(rig, learned, checked, straight, options), steps=trained.steps, left_out=still)
        report = replace(report, source=motion.source, warnings=motion.warnings)
        return TrainedNeuralRig(rig=rig, report=report, curve=trained.curve)

    def _straight(self, motion: Motion, learned: Motion, checked: Motion, straight: Straight) -> TrainedNeuralRig:
        """The rig where nothing is to be learned."""
        basis = OutputBasis.from_motion(learned, self.options.tolerance_mm, self.options.shapes, self.options.detail)
        rig = straight_rig(learned, basis)
        report = _report(rig, learned, checked, straight, self.options)
        warnings = (*motion.warnings, _nothing_to_learn(motion, report))
        report = replace(report, left_out=motion.constant, source=motion.source, warnings=warnings)
        return TrainedNeuralRig(rig=rig, report=report, curve=np.zeros((0, 3)))


def _largest_mm(straight: Straight, checked: Motion) -> float:
    off = (straight.points(row) - points for row, points in zip(checked.values, checked.points, strict=True))
    return float(max(np.linalg.norm(one, axis=1).max() for one in off))


def _nothing_to_learn(motion: Motion, report: NeuralRigReport) -> str:
    found = f"{len(motion.controls)} controls move the points straight, within {report.linear_max_mm:.5f} mm"
    plain = "" if motion.source == "samples" else ": a plain `facepipe export` is smaller, and exact"
    return f"{motion.where}: nothing to learn: {found}{plain}"


def _watched(learned: Motion, options: TrainNeuralRigOptions) -> tuple[Motion, Motion]:
    """Frames to learn, and some whose error says when to stop, which are not those that the report is on."""
    if len(np.unique(learned.blocks)) < 2:
        return learned, learned
    return learned.split(_WATCHED, options.seed)


def _samples(motion: Motion, basis: OutputBasis) -> Samples:
    from facepipe.rig.torch.network_fit import Samples

    return Samples(inputs=from_default(motion.controls, motion.values), outputs=basis.outputs(motion))


def _assembled(motion: Motion, basis: OutputBasis, trained: Trained) -> NeuralRig:
    back = np.linalg.inv(basis.metric)
    return NeuralRig(
        controls=motion.controls,
        rest=basis.rest,
        shapes=basis.shapes,
        linear=trained.linear @ back,
        hidden=trained.hidden,
        hidden_bias=trained.hidden_bias,
        last=back.T @ trained.last,
        last_bias=trained.last_bias @ back,
        topology=motion.topology.digest,
        bones=motion.bones,
        channels=basis.channels,
    )


def _report(
    rig: NeuralRig, learned: Motion, checked: Motion, straight: Straight, options: TrainNeuralRigOptions
) -> NeuralRigReport:
    models: list[NeuralRig | Straight] = [rig, straight, ridge(learned, options.tolerance_mm, options.shapes)]
    off: list[list[FloatArray]] = [[], [], []]
    for values, points in zip(checked.values, checked.points, strict=True):
        for own, one in zip(off, models, strict=True):
            own.append(np.linalg.norm(one.points(values) - points, axis=1))
    mean, largest = ([float(measure(one)) for one in off] for measure in (np.mean, np.max))
    return NeuralRigReport(
        frames=len(learned.values),
        held_out=len(checked.values),
        between=learned.between,
        shapes=len(rig.shapes),
        channels=len(rig.channels),
        steps=0,
        motion_mean_mm=float(np.linalg.norm(checked.points - checked.rest, axis=2).mean()),
        error_mean_mm=mean[0],
        error_max_mm=largest[0],
        linear_mean_mm=mean[1],
        linear_max_mm=largest[1],
        ridge_mean_mm=mean[2],
        ridge_max_mm=largest[2],
        left_out=(),
    )
