"""Bone coefficients to start from, of an animation that a face has."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.rig import matrix_coefficients, rest_coefficients
from facepipe.stage import Face

FloatArray = npt.NDArray[np.floating]


def initial_coefficients(face: Face, name: str) -> FloatArray:
    """(j, 9) coefficients of the first sample of an animation; those of transforms without shear.

    :raises InputError: no such animation
    """
    animation = next((one for one in face.animations if one.name == name), None)
    if animation is None:
        some = ", ".join(one.name for one in face.animations[:6]) or "none, the face has no animation"
        raise InputError(f"initial {name}", f"no such animation, expected one of {some}")
    joints = face.skeleton.joints
    if animation.coefficients is not None:
        found = rest_coefficients(len(joints))
        found[[joints.index(joint) for joint in animation.joints if joint in joints]] = [
            row for joint, row in zip(animation.joints, animation.coefficients[0], strict=True) if joint in joints
        ]
        return found
    local, _ = face.sample(name)
    return matrix_coefficients(np.linalg.solve(face.rig().rest, local))
