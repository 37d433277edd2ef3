"""Carry a neural rig to a new subject: by deformation gradients, and by the document's second submodel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.deformation_transfer import Transfer, spread
from facepipe.geometry.ridge import Examples
from facepipe.geometry.shape_basis import motion_basis
from facepipe.neural.invert import InvertNeuralRig
from facepipe.neural.motion import plan
from facepipe.neural.options import RetargetOptions, SampleMotionOptions
from facepipe.neural.train_neural_rig import output_metric, skinned_moves
from facepipe.parts import FaceParts
from facepipe.rig import Rig, build
from facepipe.rig.bone_coefficients import CHANNELS
from facepipe.rig.neural_rig import (
    NeuralRig,
    bones_in,
    from_default,
    most_influences,
    output_reach,
    with_basis,
    with_influences,
    with_points,
)
from facepipe.verbs.whole_faces import MILLIMETRES, Topology, whole_points, world_to_world

_INPUTS = 256  # coordinates of a deformation, at most
_SMALLEST = 1e-3  # of the largest deviation: less is no coordinate
_SAMPLES = SampleMotionOptions(spread=4000, sweep=4, together=1000)
_WIDTH = 256  # of the network's layers
_UNITS, _STEPS, _PATIENCE, _SPARSITY = 128, 4000, 1000, 0.05  # of the one layer that stands for it
_Way = Callable[[FloatArray], FloatArray]  # (n, 3) of (n, 3)
_NOISES = 10.0 ** np.arange(-3.0, 1.01, 0.25)  # millimetres
_GAIN_NOISES = 10.0 ** np.arange(-3.0, 1.01)  # millimetres
_GAIN_POINTS = 400  # that the gains are found from
_GAIN_STEPS = 3  # of Gauss and Newton: bones turn points, which is nearly straight
_GAIN_DOUBT = 0.01  # what a squared change of a gain costs, in squares of the noise at a point
_GAIN_CHANGE = 1e-4  # of a gain: how points answer to it
_LEAST_TURN = 1e-3  # of what a control does most to a bone coefficient: less is rounding of the training


def learned_by_network(
    base: NeuralRig, values: FloatArray, moved: FloatArray, *, noise: float, steps: int, tolerance: float, most: int
) -> NeuralRig:
    """The carried rig with what frames of the subject are beyond it, as one neural rig again.

    Inputs of the network are principal coordinates of the carried rig's deformations, over all that its controls do;
    outputs those of `moved`. Units of one layer learn of samples what it adds, since two layers are no neural rig.

    :param values: (f, c) controls of the frames
    :param moved: (f, n, 3) millimetres beyond the carried rig, before bones
    :param noise: strength at first, in the root mean square of the coordinates' deviations
    :param tolerance: millimetres that the shapes may leave, RMS
    :param most: shapes
    """
    from facepipe.neural.learning.deformation_network import train_deformation_network

    sampled, _ = plan(base.controls, _SAMPLES)
    moves = base.shapes if base.bones is None else skinned_moves(base.bones, base.shapes, base.channels)
    metric = output_metric(moves, base.rest, np.zeros((0, 3), np.int64), 0.0)
    middle, axes, deviations = _coordinates(base.outputs(sampled) @ metric)
    own_shapes, amounts = motion_basis(moved, tolerance, most)
    network = train_deformation_network(
        (base.outputs(values) @ metric - middle) @ axes,
        amounts,
        deviations,
        width=_WIDTH,
        steps=steps,
        noise=noise,
        seed=0,
    )
    added = network((base.outputs(sampled) @ metric - middle) @ axes)
    # the rig with shapes (q, n, 3), and units for their activations (f, q) at values (f, c)
    from facepipe.rig.torch.distil import Samples, train

    x, count = from_default(base.controls, sampled), len(base.shapes)
    watched = np.arange(len(x)) % 10 == 0
    parts = [Samples(inputs=x[rows], outputs=added[rows]) for rows in (~watched, watched)]
    trained = train(
        *parts, width=_UNITS, activation="silu", seed=0, steps=_STEPS, patience=_PATIENCE, sparsity=_SPARSITY
    )
    parted = (base.last[:count], base.last[count:])
    before, after = np.zeros((len(own_shapes), len(base.hidden))), np.zeros((len(base.last), _UNITS))
    last = [
        np.concatenate([parted[0], before, parted[1]]),
        np.insert(after, [count] * len(own_shapes), trained.last, axis=0),
    ]
    both = replace(
        base,
        shapes=np.concatenate([base.shapes, own_shapes]),
        linear=np.concatenate([base.linear[:, :count], trained.linear, base.linear[:, count:]], axis=1),
        hidden=np.concatenate([base.hidden, trained.hidden]),
        hidden_bias=np.concatenate([base.hidden_bias, trained.hidden_bias]),
        last=np.concatenate(last, axis=1),
        last_bias=np.concatenate([base.last_bias[:count], trained.last_bias, base.last_bias[count:]]),
    )
    return with_basis(both, both.shapes, np.zeros((len(base.controls), *base.rest.shape)), tolerance, most)


def _coordinates(outputs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(o,) mean of outputs (f, o), (o, i) orthonormal axes of most spread, and (i,) deviations along them."""
    middle = outputs.mean(axis=0)
    _, sizes, axes = np.linalg.svd(outputs - middle, full_matrices=False)
    deviations = sizes / np.sqrt(len(outputs))
    kept = int(np.count_nonzero(deviations[:_INPUTS] > _SMALLEST * deviations[0]))
    return middle, axes[:kept].T, deviations[:kept]


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A face that has no rig of its own yet."""

    where: str
    topology: Topology
    rest: FloatArray  # (n, 3) millimetres, Y up
    bones: Rig | None  # of its skeleton, in millimetres; None without joints

    @classmethod
    def of(cls, parts: FaceParts, where: str) -> Subject:
        """The subject of a face stage."""
        rig, to = build(parts), world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES)
        bones = bones_in(rig, to) if rig.joints else None
        return cls(where=where, topology=Topology.of(parts), rest=whole_points(parts), bones=bones)

    def checked(self, rig: NeuralRig) -> Subject:
        """The same.

        :raises TopologyError: other meshes or joints than those of the rig
        """
        if self.topology.digest != rig.topology:
            raise TopologyError(self.where, "other meshes than those of the neural rig, expected its topology")
        joints = () if self.bones is None else self.bones.joints
        if rig.bones is not None and joints != rig.bones.joints:
            expected = f"expected the rig's {len(rig.bones.joints)} (facepipe skin --from gives a face another's)"
            raise TopologyError(self.where, f"{len(joints)} joints that are not those of the neural rig, {expected}")
        return self


def carried(rig: NeuralRig, subject: Subject) -> NeuralRig:
    """The rig on the subject: its own rest and bones, and shapes that take over the deformation.

    Translations of bones are brought to the subject's size.

    :raises TopologyError: other meshes or joints than those of the rig
    """
    subject.checked(rig)
    bones = None
    if rig.bones is not None and subject.bones is not None:
        bones = with_influences(subject.bones, most_influences(rig.bones))
    rest = subject.rest if bones is None else bones.points
    transfer = Transfer(rest, subject.topology.triangles, np.zeros(len(rest), bool))
    # Carried at their largest activations, where they count: transfer is not straight in how far points go.
    sizes = output_reach(rig)[: len(rig.shapes)]
    shapes = np.empty_like(rig.shapes)
    for number, (shape, size) in enumerate(zip(rig.shapes, sizes, strict=True)):
        there = rig.rest + size * shape
        shapes[number] = (transfer.solve(rig.rest[None], there[None]) - rest) / size
    scale = np.ones(len(rig.shapes) + len(rig.channels))
    moves = rig.channels[:, 1] < CHANNELS.index("rx")
    scale[len(rig.shapes) :][moves] = spread(rest) / spread(rig.rest)
    scaled = replace(
        rig,
        rest=rest,
        bones=bones,
        linear=rig.linear * scale,
        last=rig.last * scale[:, None],
        last_bias=rig.last_bias * scale,
    )
    return with_basis(scaled, shapes, np.zeros((len(rig.controls), *rest.shape)), 0.0, len(shapes))


@dataclass(frozen=True, kw_only=True)
class RetargetReport(Report):
    """How near the subject's rig comes to frames of the subject that it was not made of, in millimetres.

    Where controls are found, each way has its own: those that it comes nearest with.
    """

    frames: int = 0
    held_out: int
    between: int = 0  # other frames, left out where clips were cut into blocks
    controls: Literal["given", "found"]
    shapes: int = 0
    noise_mm: float = 0.0
    motion_mean_mm: float  # of the held-out frames, from rest
    error_mean_mm: float
    error_max_mm: float
    transfer_mean_mm: float  # of deformation transfer from the other subject's frames
    copy_mean_mm: float  # of the other subject's deltas as they are


def compared(
    retargeted: NeuralRig, rig: NeuralRig, subject: Subject, points: FloatArray, values: FloatArray | None
) -> RetargetReport:
    """The report on frames (f, n, 3), without those that were learned, which are added later.

    :param retargeted: the subject's rig
    :param rig: the first subject's
    :param values: (f, c) controls of the frames, or None
    """
    still = rig.points(rig.values({}))
    triangles, free = subject.topology.triangles, np.zeros(len(still), bool)
    there, back = Transfer(subject.rest, triangles, free), Transfer(still, triangles, free)

    def distances(model: NeuralRig, as_its_own: _Way, as_subjects: _Way) -> FloatArray:
        controls = values
        if controls is None:
            controls = InvertNeuralRig()(model, np.stack([as_its_own(point) for point in points])).values
        made = np.stack([as_subjects(model.points(row)) for row in controls])
        return np.asarray(np.linalg.norm(made - points, axis=2))

    off = distances(retargeted, lambda one: one, lambda one: one)
    copied = distances(rig, lambda one: still + one - subject.rest, lambda one: subject.rest + one - still)
    transferred = distances(
        rig, lambda one: back.solve(subject.rest[None], one[None]), lambda one: there.solve(still[None], one[None])
    )
    return RetargetReport(
        held_out=len(points),
        controls="found" if values is None else "given",
        motion_mean_mm=float(np.linalg.norm(points - subject.rest, axis=2).mean()),
        error_mean_mm=float(off.mean()),
        error_max_mm=float(off.max()),
        transfer_mean_mm=float(transferred.mean()),
        copy_mean_mm=float(copied.mean()),
    )


@dataclass(frozen=True, kw_only=True)
class Retargeted:
    """The subject's rig, and how good it is."""

    rig: NeuralRig
    report: RetargetReport


@dataclass(frozen=True, kw_only=True)
class RetargetNeuralRig:
    """Parameters of one subject's rig drive another.

    The rig is first carried over by deformation transfer. What frames of the subject are beyond that is learned point
    by point: a linear map of the rig's controls and of the point's own motion, under noise (`geometry.point_ridge`).
    Both are straight, so the composed model is one neural rig. Controls that aren't given are found by the inverse of
    what is there: first of the carried rig, then of the one that was learned.

    Source: neural-face-rig, claims 1 and 7-9, S401-S404 and S501-S502; point by point and in closed form, where the
    document has a network of the whole deformation and draws its noise; mode network is that.
    """

    options: RetargetOptions = field(default_factory=RetargetOptions)

    @one_thread()
    def __call__(
        self,
        rig: NeuralRig,
        subject: Subject,
        points: FloatArray,
        values: FloatArray | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> Retargeted:
        """The rig of a subject.

        :param points: (f, n, 3) millimetres, of the new subject
        :param values: (f, c) controls of the frames; None: those are found that the rig so far comes nearest with
        :param done: called as each time that controls were found and learned from, at most `calls` times
        :raises InputError: NaN, or fewer than two frames
        :raises TopologyError: other meshes or joints than those of the rig, or counts that don't fit
        """
        subject.checked(rig)
        if len(points) < 2:
            raise InputError(subject.where, f"{len(points)} frames, expected two or more")
        for label, array, shape in (
            ("points", points, (len(points), len(rig.rest), 3)),
            ("controls", values, (len(points), len(rig.controls))),
        ):
            if array is not None and np.shape(array) != shape:
                raise TopologyError(f"{subject.where} -> {label}", f"shape {np.shape(array)}, expected {shape}")
            if array is not None:
                require_finite(array, subject.where, label)
        points = np.asarray(points, dtype=np.float64)
        kept = min(max(1, round(len(points) * (1.0 - self.options.held_out))), len(points) - 1)
        base = carried(rig, subject)
        tried, noise = self._learned(base, points[:kept], None if values is None else values[:kept], -1.0, done)
        report = compared(tried, rig, subject, points[kept:], None if values is None else values[kept:])
        done()
        whole, _ = self._learned(base, points, values, noise, done)
        report = replace(report, frames=kept, shapes=len(whole.shapes), noise_mm=noise)
        return Retargeted(rig=whole, report=report)

    @property
    def calls(self) -> int:
        """How often `done` is called at most."""
        return 2 * self.options.rounds + 1

    def _learned(
        self, base: NeuralRig, points: FloatArray, values: FloatArray | None, noise: float, done: Callable[[], object]
    ) -> tuple[NeuralRig, float]:
        """The rig, and the noise that it was learned under; where controls are found, again with those of the last."""
        if values is not None:
            return self._fitted(base, values, points, noise)
        learned, chosen = base, noise
        for _ in range(self.options.rounds):
            learned, chosen = self._fitted(base, InvertNeuralRig()(learned, points).values, points, noise)
            done()
        return learned, chosen

    def _fitted(
        self, base: NeuralRig, values: FloatArray, points: FloatArray, noise: float = -1.0
    ) -> tuple[NeuralRig, float]:
        base = with_own_gains(base, values, points)
        examples = _subject_examples(base, values, points)
        if self.options.mode == "network":
            options = self.options
            return learned_by_network(
                base,
                values,
                examples.moved,
                noise=options.noise,
                steps=options.steps,
                tolerance=options.tolerance_mm,
                most=options.shapes,
            ), 0.0
        noise = self.options.noise_mm if self.options.noise_mm >= 0.0 else noise
        noise = examples.best_noise(_NOISES) if noise < 0.0 else noise
        maps = examples.maps(max(noise, 1e-6))
        shapes = base.shapes + np.einsum("rni,nij->rnj", base.shapes, maps.by_vector)
        return with_basis(base, shapes, maps.by_input, self.options.tolerance_mm, self.options.shapes), noise


def _subject_examples(rig: NeuralRig, values: FloatArray, points: FloatArray) -> Examples:
    """Frames as examples for every point: its own motion by the rig, before bones, and how far it went beyond that.

    :param values: (f, c) controls of the frames
    :param points: (f, n, 3) millimetres
    """
    outputs = rig.outputs(values)
    own_motion = rig.morphed(outputs) - rig.rest
    # (c, n) millimetres that each control alone moves each point, at the further one of its limits
    still, strengths = rig.points(rig.values({})), np.zeros((len(rig.controls), len(rig.rest)))
    for number, control in enumerate(rig.controls):
        for limit in (control.minimum, control.maximum):
            moved = rig.values({})
            moved[number] = limit
            strengths[number] = np.maximum(strengths[number], np.linalg.norm(rig.points(moved) - still, axis=1))
    return Examples(
        inputs=from_default(rig.controls, values),
        vectors=own_motion,
        strengths=strengths,
        moved=_before_bones(rig, outputs, points) - rig.rest - own_motion,
    )


def _before_bones(rig: NeuralRig, outputs: FloatArray, points: FloatArray) -> FloatArray:
    """(f, n, 3) what points (f, n, 3) were before the rig's bones moved them, of outputs (f, r + m)."""
    bones = rig.bones
    if bones is None:
        return np.asarray(points, dtype=np.float64)
    local = map(bones.local_transforms, rig.coefficients(outputs))
    return np.stack(
        [
            bones.unskin(np.asarray(frame, np.float64), bones.skinning_matrices(one))
            for frame, one in zip(points, local, strict=True)
        ]
    )


def with_own_gains(rig: NeuralRig, values: FloatArray, points: FloatArray) -> NeuralRig:
    """The rig whose controls move its bones as strongly as the subject's do: a gain on each control's straight part.

    Gains are shared by all points, so frames determine them better than any point's own map; a difference that points
    can make alike by maps of their own counts less (generalised least squares: residuals weighed by the inverse of what
    such maps and the noise are expected to bring). Controls that frames don't determine keep a gain of 1.

    :param values: (f, c) controls of the frames
    :param points: (f, n, 3) millimetres
    """
    turns = np.abs(rig.linear[:, len(rig.shapes) :])
    moving = np.flatnonzero((turns > _LEAST_TURN * turns.max(axis=0, initial=0.0)).any(axis=1))
    if not len(moving):
        return rig
    chosen = np.arange(0, len(rig.rest), max(1, len(rig.rest) // _GAIN_POINTS))
    some, points = with_points(rig, chosen), points[:, chosen]
    noise, gains = _subject_examples(some, values, points).best_noise(_GAIN_NOISES), np.ones(len(moving))
    for _ in range(_GAIN_STEPS):
        now = _scaled(some, moving, gains)
        # (f, k, n, 3) how points before bones answer to the gains of k controls
        x, outputs, shapes = from_default(some.controls, values), now.outputs(values), len(some.shapes)
        still = _before_bones(now, outputs, points)
        slopes = np.zeros((len(x), len(moving), *still.shape[1:]))
        for frame, row in enumerate(x[:, moving]):
            moved = np.flatnonzero(row)
            if not len(moved):
                continue
            changed = np.tile(outputs[frame], (len(moved), 1))
            changed[:, shapes:] += _GAIN_CHANGE * row[moved, None] * some.linear[moving[moved], shapes:]
            there = _before_bones(now, changed, np.broadcast_to(points[frame], (len(moved), *still.shape[1:])))
            slopes[frame, moved] = (there - still[frame]) / _GAIN_CHANGE
        matrix, off = _subject_examples(now, values, points).normal(slopes, max(noise, 1e-6))
        # Gauss-Newton on r'Wr + d |g - 1|^2: d holds the gains that frames don't determine at 1.
        gains -= np.linalg.solve(matrix + _GAIN_DOUBT * np.eye(len(moving)), off + _GAIN_DOUBT * (gains - 1.0))
    return _scaled(rig, moving, gains)


def _scaled(rig: NeuralRig, controls: IntArray, gains: FloatArray) -> NeuralRig:
    linear = rig.linear.copy()
    linear[controls, len(rig.shapes) :] *= gains[:, None]
    return replace(rig, linear=linear)
