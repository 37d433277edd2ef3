"""What frames of a subject show beyond a rig that was carried to it, for each point to learn."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.ridge import Examples
from facepipe.rig.neural_rig import NeuralRig, from_default


def subject_examples(rig: NeuralRig, values: FloatArray, points: FloatArray) -> Examples:
    """Frames as examples for every point: its own motion by the rig, before bones, and how far it went beyond that.

    :param values: (f, c) controls of the frames
    :param points: (f, n, 3) millimetres
    """
    outputs = rig.outputs(values)
    own = rig.morphed(outputs) - rig.rest
    return Examples(
        inputs=from_default(rig.controls, values),
        vectors=own,
        strengths=_strengths(rig),
        moved=before_bones(rig, outputs, points) - rig.rest - own,
    )


def before_bones(rig: NeuralRig, outputs: FloatArray, points: FloatArray) -> FloatArray:
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
