"""The truth about a portrait in the unknowns of a photo fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from recovery_targets import RecoveryTarget
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from facepipe.photo.descent.landmark_fit import State
    from facepipe.photo.descent.subject import PoseSpace, Subject
    from facepipe.pictures.camera import Camera

FloatArray = npt.NDArray[np.floating]


def true_state(made: RecoveryTarget, subject: Subject, space: PoseSpace) -> State:
    """Sliders, expression and pose as they are."""
    from facepipe.photo.descent.landmark_fit import State

    values = np.array([made.sliders[slider.name] for slider in subject.free_sliders])
    weights = [made.expressions.get(subject.rig.shapes[i], 0.0) for i in subject.expressions]
    return State(
        shares=(values - subject.lower) / (subject.upper - subject.lower),
        expressions=np.array([weights]),
        poses=pose_of(made.camera, space)[None],
    )


def pose_of(camera: Camera, space: PoseSpace) -> FloatArray:
    """(7,) as `PoseSpace`, whose principal point lies in the middle of the picture as the camera's does."""
    local = camera.axes @ (space.middle - camera.eye)
    distance = -local[2]
    at = np.array(camera.center) + camera.focal * np.array([local[0], -local[1]]) / distance
    size = np.log(camera.focal * space.size / distance / space.side)
    turn = Rotation.from_matrix(camera.axes).as_rotvec()
    return np.array([*turn, *at / space.side, size, np.log(distance / space.size)])
