"""Bone coefficients to start from: of an animation that a face has, or of a payload."""

from __future__ import annotations

from pathlib import Path
from typing import TypeGuard

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.payload import decode
from facepipe.processors.apply_bones import check_fits
from facepipe.processors.bone_payload import SUFFIX, payload_bytes
from facepipe.rig import matrix_coefficients, rest_coefficients
from facepipe.stage import Face


def initial_coefficients(face: Face, word: str) -> FloatArray:
    """(j, 9) coefficients of the first sample of an animation (those of transforms without shear), or of a .fpb file.

    :raises InputError: no such animation, or a file that can't be read or is for another face
    """
    if is_payload(word):
        content = decode(payload_bytes(Path(word)), face.skeleton.joints, word)
        check_fits(face, content)
        return np.asarray(content.frames[0])
    animation = next((one for one in face.animations if one.name == word), None)
    if animation is None:
        known = [one.name for one in face.animations]
        raise InputError(f"initial {word}", f"no such animation{suggestion(word, known)}")
    joints = face.skeleton.joints
    if animation.coefficients is not None:
        found = rest_coefficients(len(joints))
        found[[joints.index(joint) for joint in animation.joints if joint in joints]] = [
            row for joint, row in zip(animation.joints, animation.coefficients[0], strict=True) if joint in joints
        ]
        return found
    local, _ = face.sample(word)
    return matrix_coefficients(np.linalg.solve(face.rig().rest, local))


def is_payload(word: str | None) -> TypeGuard[str]:
    """Whether coefficients to start from are a file's; names of animations have no suffix."""
    return word is not None and Path(word).suffix.lower() == SUFFIX
