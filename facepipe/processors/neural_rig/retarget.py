"""Carry a neural rig to a new subject, of some frames of that subject: the document's second submodel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError, TopologyError
from facepipe.finite import require_finite
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.geometry.motion_basis import motion_basis
from facepipe.geometry.point_ridge import Examples
from facepipe.options import check_ranges
from facepipe.processors.neural_rig.carried_rig import Subject, carried, reach
from facepipe.reports import Report
from facepipe.rig.neural_rig import NeuralRig, from_default

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_NOISES = 10.0 ** np.arange(-3.0, 1.01, 0.25)  # millimetres


@dataclass(frozen=True, kw_only=True)
class RetargetOptions:
    """How a neural rig is carried to a subject.

    :raises InputError: a number out of range
    """

    noise_mm: float = field(
        default=-1.0,
        metadata={
            "help": "noise on what the rig says while the subject is learned; -1: what does best on frames left out",
            "unit": "mm",
            "range": (-1.0, 100.0),
        },
    )
    held_out: float = field(
        default=0.15,
        metadata={"help": "share of the frames, the last ones, that the report is on", "range": (0.01, 0.9)},
    )
    shapes: int = field(default=256, metadata={"help": "most shapes of the subject's rig", "range": (1, 2048)})
    tolerance_mm: float = field(
        default=0.005, metadata={"help": "what those may leave, RMS", "unit": "mm", "range": (0.0, 10.0)}
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class RetargetReport(Report):
    """How near the subject's rig comes to frames of the subject that it was not made of, in millimetres."""

    frames: int
    held_out: int
    shapes: int
    noise_mm: float
    motion_mean_mm: float  # of the held-out frames, from rest
    error_mean_mm: float
    error_max_mm: float
    transfer_mean_mm: float  # of deformation transfer from the other subject's frames
    copy_mean_mm: float  # of the other subject's deltas as they are


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
    Both are straight, so the composed model is one neural rig.

    Source: neural-face-rig, claims 1 and 7-9, S401-S404 and S501-S502. A fully connected network of the whole
    deformation, as there, learns nothing of a hundred frames that holds on others; see docs/neural_rig.md.
    """

    options: RetargetOptions = field(default_factory=RetargetOptions)

    def __call__(self, rig: NeuralRig, subject: Subject, values: FloatArray, points: FloatArray) -> Retargeted:
        """The rig of a subject.

        :param values: (f, c) controls of the rig that make its own subject do what the frames show
        :param points: (f, n, 3) millimetres, of the new subject
        :raises InputError: NaN, or fewer than two frames
        :raises TopologyError: other meshes or joints than those of the rig, or counts that don't fit
        """
        _check(rig, subject, values, points)
        kept = max(1, round(len(points) * (1.0 - self.options.held_out)))
        kept = min(kept, len(points) - 1)
        base = carried(rig, subject)
        tried, noise = self._fitted(base, values[:kept], points[:kept])
        report = _report(tried, rig, subject, values[kept:], points[kept:])
        whole, _ = self._fitted(base, values, points, noise)
        return Retargeted(rig=whole, report=replace(report, frames=kept, shapes=len(whole.shapes), noise_mm=noise))

    def _fitted(
        self, base: NeuralRig, values: FloatArray, points: FloatArray, noise: float = -1.0
    ) -> tuple[NeuralRig, float]:
        outputs = base.outputs(values)
        own = base.morphed(outputs) - base.rest
        examples = Examples(
            inputs=from_default(base.controls, values),
            own=own,
            strengths=_strengths(base),
            moved=_morphed(base, outputs, points) - base.rest - own,
        )
        noise = self.options.noise_mm if self.options.noise_mm >= 0.0 else noise
        noise = examples.best_noise(_NOISES) if noise < 0.0 else noise
        maps = examples.maps(max(noise, 1e-6))
        return self._composed(base, maps.by_input, maps.by_own), noise

    def _composed(self, base: NeuralRig, by_input: FloatArray, by_own: FloatArray) -> NeuralRig:
        """One rig of what was carried and what was learned, over few orthonormal shapes again."""
        count = len(base.shapes)
        shapes = base.shapes + np.einsum("rni,nij->rnj", base.shapes, by_own)
        rows = np.concatenate([shapes, by_input])
        sizes = np.concatenate([reach(base)[:count], np.ones(len(by_input))])
        basis, amounts = motion_basis(rows * sizes[:, None, None], self.options.tolerance_mm, self.options.shapes)
        amounts = amounts / sizes[:, None]  # (r + c, new) of each row
        to_new, to_controls = amounts[:count], amounts[count:]
        return replace(
            base,
            shapes=basis,
            linear=np.concatenate([base.linear[:, :count] @ to_new + to_controls, base.linear[:, count:]], axis=1),
            last=np.concatenate([to_new.T @ base.last[:count], base.last[count:]]),
            last_bias=np.concatenate([base.last_bias[:count] @ to_new, base.last_bias[count:]]),
        )


def frames_of_first(rig: NeuralRig, first: Subject, second: Subject, points: FloatArray) -> FloatArray:
    """(f, n, 3) frames of the second subject as the first one would make them, by deformation transfer.

    The neural rig of the first one finds its controls for them.
    """
    transfer = Transfer(first.rest, second.checked(rig).topology.triangles, np.zeros(len(first.rest), bool))
    return np.stack([transfer.solve(second.rest[None], frame[None]) for frame in np.asarray(points, np.float64)])


def _check(rig: NeuralRig, subject: Subject, values: FloatArray, points: FloatArray) -> None:
    subject.checked(rig)
    if len(points) < 2:
        raise InputError(subject.where, f"{len(points)} frames, expected two or more")
    for what, found, shape in (
        ("points", np.shape(points), (len(points), len(rig.rest), 3)),
        ("controls", np.shape(values), (len(points), len(rig.controls))),
    ):
        if found != shape:
            raise TopologyError(f"{subject.where} -> {what}", f"shape {found}, expected {shape}")
    require_finite(points, subject.where, "points")
    require_finite(values, subject.where, "controls")


def _strengths(rig: NeuralRig) -> FloatArray:
    """(c, n) millimetres that each control alone moves each point, at the further one of its limits."""
    rest = rig.values({})
    found = np.zeros((len(rig.controls), len(rig.rest)))
    still = rig.points(rest)
    for number, control in enumerate(rig.controls):
        for limit in (control.minimum, control.maximum):
            moved = rest.copy()
            moved[number] = limit
            found[number] = np.maximum(found[number], np.linalg.norm(rig.points(moved) - still, axis=1))
    return found


def _morphed(rig: NeuralRig, outputs: FloatArray, points: FloatArray) -> FloatArray:
    """(f, n, 3) frames before the rig's bones moved them."""
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


def _report(
    found: NeuralRig, rig: NeuralRig, subject: Subject, values: FloatArray, points: FloatArray
) -> RetargetReport:
    still = rig.points(rig.values({}))
    transfer = Transfer(subject.rest, subject.topology.triangles, np.zeros(len(subject.rest), bool))
    own, off, copied, moved = [], [], [], []
    for row, frame in zip(values, points, strict=True):
        first = rig.points(row)
        own.append(np.linalg.norm(found.points(row) - frame, axis=1))
        off.append(np.linalg.norm(transfer.solve(still[None], first[None]) - frame, axis=1))
        copied.append(np.linalg.norm(subject.rest + first - still - frame, axis=1))
        moved.append(np.linalg.norm(frame - subject.rest, axis=1))
    return RetargetReport(
        frames=0,
        held_out=len(points),
        shapes=0,
        noise_mm=0.0,
        motion_mean_mm=float(np.mean(moved)),
        error_mean_mm=float(np.mean(own)),
        error_max_mm=float(np.max(own)),
        transfer_mean_mm=float(np.mean(off)),
        copy_mean_mm=float(np.mean(copied)),
    )
