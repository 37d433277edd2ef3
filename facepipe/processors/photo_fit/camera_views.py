"""The cameras of a fit as the stage holds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError

if TYPE_CHECKING:
    from facepipe.learn.photo.result import FittedCamera

_MARGIN = 10.0  # the clipping range is so many times wider than the face, each way
_LEAST_NEAR = 1e-4  # of the farthest depth, where the face reaches behind the camera


def camera_to_world(camera: FittedCamera) -> FloatArray:
    """(4, 4) rigid transform from camera to world coordinates."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(np.asarray(camera.rotation, dtype=np.float64)).as_matrix()
    result = np.eye(4)
    result[:3, :3] = rotation.T
    result[:3, 3] = -rotation.T @ np.asarray(camera.translation, dtype=np.float64)
    return result


def clipping_range(where: str, to_world: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Nearest and farthest depth to show of world points (n, 3), with a margin.

    :raises FitError: all points are behind the camera
    """
    depths = (to_world[:3, 3] - points) @ to_world[:3, 2]
    far = float(depths.max(initial=0.0))
    if far <= 0:
        raise FitError(where, "the camera looks away from the face, expected the face before it")
    return max(float(depths.min()) / _MARGIN, far * _LEAST_NEAR), far * _MARGIN
