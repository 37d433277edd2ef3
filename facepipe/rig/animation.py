"""Samples of animations as local joint transforms and shape weights."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.parts import Animation, Skeleton
from facepipe.rig.bone_coefficients import coefficient_matrices

FloatArray = npt.NDArray[np.floating]


def sample_transforms(skeleton: Skeleton, animation: Animation, index: int = 0) -> FloatArray:
    """(j, 4, 4) local transforms of the whole skeleton at one sample; joints not animated are at rest.

    Bone coefficients win over the transforms where the animation has both: USD keeps scales in half precision.

    :raises InputError: a joint that the skeleton has not
    """
    local = np.array(skeleton.rest_transforms, dtype=np.float64)
    place = {joint: i for i, joint in enumerate(skeleton.joints)}
    missing = [joint for joint in animation.joints if joint not in place]
    if missing:
        raise InputError(animation.name, f"'{missing[0]}' is no joint of the skeleton")
    rows = [place[joint] for joint in animation.joints]
    if animation.coefficients is not None:
        local[rows] = local[rows] @ coefficient_matrices(animation.coefficients[index])
    elif animation.translations is not None and animation.rotations is not None:
        scales = np.ones((len(rows), 3)) if animation.scales is None else animation.scales[index]
        local[rows] = compose(animation.translations[index], animation.rotations[index], scales)
    return local


def sample_weights(animation: Animation, index: int = 0) -> dict[str, float]:
    """Shape weights at one sample, by name."""
    if animation.shape_weights is None:
        return {}
    return {name: float(weight) for name, weight in zip(animation.shapes, animation.shape_weights[index], strict=True)}


def compose(translations: FloatArray, rotations: FloatArray, scales: FloatArray) -> FloatArray:
    """(n, 4, 4) matrices T R S of (n, 3), (n, 4) quaternions x y z w, and (n, 3)."""
    from scipy.spatial.transform import Rotation

    matrices = np.tile(np.eye(4), (len(translations), 1, 1))
    if len(matrices):
        matrices[:, :3, :3] = Rotation.from_quat(rotations).as_matrix() * np.asarray(scales)[:, None, :]
        matrices[:, :3, 3] = translations
    return matrices


def decompose(matrices: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Translations (n, 3), quaternions x y z w (n, 4) and scales (n, 3) of (n, 4, 4) matrices without shear.

    A mirrored matrix (negative determinant) gives a negative x scale.
    """
    from scipy.spatial.transform import Rotation

    linear = np.asarray(matrices, dtype=np.float64)[:, :3, :3]
    scale = np.linalg.norm(linear, axis=1)
    scale[:, 0] *= np.where(np.linalg.det(linear) < 0, -1.0, 1.0)
    rotation = linear / np.where(scale == 0, 1.0, scale)[:, None, :]
    quaternions = Rotation.from_matrix(rotation).as_quat() if len(matrices) else np.zeros((0, 4))
    return np.asarray(matrices)[:, :3, 3], quaternions, scale
