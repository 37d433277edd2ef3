"""Train a neural rig: controls to deformation, the first submodel forward; its outputs, and straight models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report, not_in_json
from facepipe.core.threads import one_thread
from facepipe.geometry.gradient_system import cotangent_weights, incidence
from facepipe.geometry.shape_basis import local_basis, motion_basis
from facepipe.neural.motion import Motion
from facepipe.neural.options import TrainNeuralRigOptions
from facepipe.neural.train_encoder import Checkpoint
from facepipe.rig import Rig, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_derivatives
from facepipe.rig.neural_rig import NeuralRig, from_default, with_influences

if TYPE_CHECKING:
    from facepipe.neural.train_encoder import EncoderReport
    from facepipe.rig.torch.distil import Samples, Trained

_MOVES = 1e-9  # of a coefficient over all frames; less is rounding
_FIRM = 1e-6  # of the mean square: outputs that do the same are separated by their size
_PENALTIES = 10.0 ** np.arange(-8.0, 3.0, 0.5)  # of the largest singular value's square
_WATCHED = 0.1  # of the frames to learn
_STRAIGHT_MM = 1e-3  # more than blendshapes may be off where there is nothing to learn beside them


@dataclass(frozen=True, kw_only=True)
class OutputBasis:
    """Shapes of what bones leave, and bones; squares of outputs times the metric are errors of points."""

    rest: FloatArray  # (n, 3) millimetres
    shapes: FloatArray  # (r, n, 3) orthonormal
    channels: IntArray  # (m, 2) joint, coefficient
    metric: FloatArray  # (r + m, r + m) lower triangular; of `output_metric`

    @classmethod
    def from_motion(cls, motion: Motion, tolerance: float, most: int, detail: float) -> OutputBasis:
        """The basis of a motion.

        :param tolerance: millimetres that the shapes may leave, RMS
        :param most: shapes
        :param detail: what an error of differential coordinates counts beside one of points
        """
        bones = motion.bones
        rest = motion.rest if bones is None else bones.points
        moves = shapes = local_basis(motion_basis(_morphs(motion, rest), tolerance, most)[0])
        channels = np.zeros((0, 2), np.int64)
        if bones is not None and motion.coefficients is not None:
            channels = np.argwhere(np.ptp(motion.coefficients, axis=0) > _MOVES)
            moves = skinned_moves(bones, shapes, channels)
            kept = np.abs(moves[len(shapes) :]).any(axis=(1, 2))  # what moves no point needs no output
            channels, moves = channels[kept], np.concatenate([moves[: len(shapes)], moves[len(shapes) :][kept]])
        metric = output_metric(moves, motion.rest, motion.topology.triangles, detail)
        return cls(rest=rest, shapes=shapes, channels=channels, metric=metric)

    def outputs(self, motion: Motion) -> FloatArray:
        """(f, r + m) of the frames, times the metric."""
        flat = self.shapes.reshape(len(self.shapes), -1)
        activations = _morphs(motion, self.rest).reshape(len(motion.values), -1) @ flat.T.astype(np.float32)
        if motion.coefficients is None:
            return np.asarray(activations @ self.metric)
        moved = motion.coefficients - rest_coefficients(motion.coefficients.shape[1])
        return np.concatenate([activations, moved[:, self.channels[:, 0], self.channels[:, 1]]], axis=1) @ self.metric


def _morphs(motion: Motion, rest: FloatArray) -> FloatArray:
    """(f, n, 3) float32: offsets from rest before bones move them."""
    morphs = np.empty(motion.points.shape, np.float32)
    for frame in range(len(morphs)):
        morphs[frame] = motion.morphed(frame) - rest
    return morphs


def output_metric(moves: FloatArray, rest: FloatArray, triangles: IntArray, detail: float) -> FloatArray:
    """(o, o) lower triangular C: ``|outputs C|^2`` is the squared error over all points, to first order.

    Differential coordinates of a point are its offset from the mean of its neighbours (Sorkine, "Differential
    Representations for Mesh Processing", 2006); they show dents that distances hardly do.

    :param moves: (o, n, 3) what a unit of each output moves
    :param detail: what an error of differential coordinates counts beside one of points
    """
    flat = moves.reshape(len(moves), -1)
    products = flat @ flat.T
    if detail > 0.0 and len(triangles):
        edges = cotangent_weights(rest, triangles)[0]
        ends = incidence(edges, len(rest))
        degree = np.maximum(np.bincount(edges.ravel(), minlength=len(rest)), 1)
        bends = ends.T @ (ends @ moves.transpose(1, 0, 2).reshape(len(rest), -1)) / degree[:, None]
        bends = bends.reshape(len(rest), len(moves), 3).transpose(1, 0, 2).reshape(len(moves), -1)
        products += detail * bends @ bends.T
    return np.asarray(np.linalg.cholesky(products + _FIRM * np.trace(products) / len(products) * np.eye(len(products))))


def skinned_moves(bones: Rig, shapes: FloatArray, channels: IntArray) -> FloatArray:
    """(r + m, n, 3) what a unit of each shape's activation and of each bone coefficient moves at rest.

    :param shapes: (r, n, 3) before the bones
    :param channels: (m, 2) joint, coefficient
    """
    matrices = bones.skinning_matrices(bones.rest)[:, :3]
    turned = (bones.influences @ matrices.reshape(-1, 12)).reshape(-1, 3, 4)[:, :, :3]
    worlds = bones.joint_worlds(bones.rest)
    by_own = bones.rest[:, None] @ coefficient_derivatives(rest_coefficients(len(bones.joints)))
    parents = np.concatenate([worlds, bones.parent_world[None]])[bones.parents]  # -1: what roots hang under
    is_below = np.eye(len(bones.joints), dtype=bool)  # of each joint: itself and all under it
    for joint in range(len(bones.joints) - 1, -1, -1):
        if bones.parents[joint] >= 0:
            is_below[bones.parents[joint]] |= is_below[joint]
    moves = np.empty((len(channels), len(bones.points), 3))
    for number, (joint, channel) in enumerate(channels):
        below = np.flatnonzero(is_below[joint])
        turn = parents[joint] @ by_own[joint, channel] @ np.linalg.inv(worlds[joint])
        matrices = (turn @ worlds[below] @ bones.inverse_bind[below])[:, :3]
        blended = (bones.influences[:, below] @ matrices.reshape(len(below), 12)).reshape(-1, 3, 4)
        moves[number] = np.einsum("nij,nj->ni", blended[:, :, :3], bones.points) + blended[:, :, 3]
    return np.concatenate([np.einsum("nij,rnj->rni", turned, shapes), moves])


@dataclass(frozen=True, kw_only=True)
class Straight:
    """``rest + [x, 1] shapes`` of x, the controls from their defaults."""

    motion: Motion  # that it was fitted to
    shapes: FloatArray  # (c + 1, 3n) millimetres

    def points(self, values: FloatArray) -> FloatArray:
        """(n, 3) of (c,) values."""
        row = np.append(from_default(self.motion.controls, values), 1.0)
        return np.asarray(self.motion.rest + (row @ self.shapes).reshape(-1, 3))


def best_blendshapes(motion: Motion) -> Straight:
    """One blendshape a control, and an offset, of least squared error on all frames."""
    deltas = (motion.points - motion.rest).reshape(len(motion.values), -1)
    return Straight(motion=motion, shapes=np.linalg.lstsq(_rows(motion), deltas, rcond=None)[0])


def ridge(motion: Motion, tolerance: float, most: int) -> Straight:
    """Ridge regression from the controls to principal components; its penalty by generalised cross-validation.

    Source: Golub, Heath, Wahba, Generalized cross-validation as a method for choosing a good ridge parameter (1979).

    :param tolerance: millimetres that the components may leave, RMS
    :param most: components
    """
    components, activations = motion_basis(motion.points - motion.rest, tolerance, most)
    left, sizes, right = np.linalg.svd(_rows(motion), full_matrices=False)
    along = left.T @ activations
    best, least = np.zeros_like(sizes), np.inf
    for penalty in _PENALTIES * sizes[0] ** 2:
        kept = sizes**2 / (sizes**2 + penalty)
        # |(I - A) y|^2 / trace(I - A)^2, with A = U diag(kept) U^T: one decomposition serves every penalty
        off = np.sum(activations**2) - np.sum((1.0 - (1.0 - kept[:, None]) ** 2) * along**2)
        score = off / (len(left) - kept.sum()) ** 2 if len(left) > kept.sum() else np.inf
        if score < least:
            best, least = kept / np.where(sizes > 0.0, sizes, 1.0), score
    weights = right.T @ (best[:, None] * along)
    return Straight(motion=motion, shapes=weights @ components.reshape(len(components), -1))


def _rows(motion: Motion) -> FloatArray:
    x = from_default(motion.controls, motion.values)
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)


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
        from facepipe.rig.torch.distil import train
        from facepipe.rig.torch.one_thread import best_device

        options, still = self.options, motion.constant
        if motion.bones is not None and options.influences:
            motion = replace(motion, bones=with_influences(motion.bones, options.influences))
        if len(still) == len(motion.controls):
            raise InputError(motion.where, "no control moves in any frame, expected one or more that do")
        learned, checked = motion.without(still).split(options.held_out, options.seed)
        straight = best_blendshapes(learned)
        off = (straight.points(row) - points for row, points in zip(checked.values, checked.points, strict=True))
        if float(max(np.linalg.norm(one, axis=1).max() for one in off)) <= _STRAIGHT_MM:
            return self._straight(motion, learned, checked, straight)
        kept = Checkpoint.for_training(checkpoint, "rig", motion, options) if checkpoint else None
        # frames to learn, and some whose error says when to stop, which are not those that the report is on
        several = len(np.unique(learned.blocks)) > 1
        taught, watched = learned.split(_WATCHED, options.seed) if several else (learned, learned)
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
        # the map of least squared error on all frames, which is 0 where the controls are at their defaults
        inputs = from_default(learned.controls, learned.values)
        outputs = basis.outputs(learned) @ np.linalg.inv(basis.metric)
        count = outputs.shape[1]
        rig = NeuralRig(
            controls=learned.controls,
            rest=basis.rest,
            shapes=basis.shapes,
            linear=np.linalg.lstsq(inputs, outputs, rcond=None)[0],
            hidden=np.zeros((0, len(learned.controls))),
            hidden_bias=np.zeros(0),
            last=np.zeros((count, 0)),
            last_bias=np.zeros(count),
            topology=learned.topology.digest,
            bones=learned.bones,
            channels=basis.channels,
        )
        report = _report(rig, learned, checked, straight, self.options)
        found = f"{len(motion.controls)} controls move the points straight, within {report.linear_max_mm:.5f} mm"
        plain = "" if motion.source == "samples" else ": a plain `facepipe export` is smaller, and exact"
        warnings = (*motion.warnings, f"{motion.where}: nothing to learn: {found}{plain}")
        report = replace(report, left_out=motion.constant, source=motion.source, warnings=warnings)
        return TrainedNeuralRig(rig=rig, report=report, curve=np.zeros((0, 3)))


def _samples(motion: Motion, basis: OutputBasis) -> Samples:
    from facepipe.rig.torch.distil import Samples

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
    # All three on the same frames, which none of them was fitted to.
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
