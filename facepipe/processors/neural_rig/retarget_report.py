"""How near a retargeted rig comes to frames of the subject, beside what takes no frames of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.processors.neural_rig.carried_rig import Subject
from facepipe.processors.neural_rig.invert import InvertNeuralRig
from facepipe.rig.neural_rig import NeuralRig

_Way = Callable[[FloatArray], FloatArray]  # (n, 3) of (n, 3)


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
            controls = InvertNeuralRig()(model, np.stack([as_its_own(one) for one in points])).values
        made = np.stack([as_subjects(model.points(row)) for row in controls])
        return np.asarray(np.linalg.norm(made - points, axis=2))

    off = distances(retargeted, lambda one: one, lambda one: one)
    copied = distances(rig, lambda one: still + one - subject.rest, lambda one: subject.rest + one - still)
    transferred = distances(
        rig,
        lambda one: back.solve(subject.rest[None], one[None]),
        lambda one: there.solve(still[None], one[None]),
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
