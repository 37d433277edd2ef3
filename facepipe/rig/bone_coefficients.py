"""Bone coefficients: 9 numbers a joint, relative to its rest transform (DESIGN section 7).

``M = T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` in column vectors, channels in the order of `CHANNELS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import find_joint

CHANNELS = ("tx", "ty", "tz", "rx", "ry", "rz", "sx", "sy", "sz")


def rest_coefficients(joint_count: int) -> FloatArray:
    """(j, 9) coefficients that leave every joint at rest: no translation or rotation, scale 1."""
    coefficients = np.zeros((joint_count, 9))
    coefficients[:, 6:] = 1.0
    return coefficients


def coefficient_matrices(coefficients: FloatArray) -> FloatArray:
    """(..., 4, 4) matrices M of (..., 9) coefficients; translation in stage units, rotation in radians.

    Source: bone order of photo-to-face-sliders [0226], [0233]-[0237], written for column vectors.
    """
    coefficients = np.asarray(coefficients, dtype=np.float64)
    matrices = np.zeros((*coefficients.shape[:-1], 4, 4))
    matrices[..., :3, :3] = _rotation(coefficients[..., 3:6]) * coefficients[..., None, 6:9]
    matrices[..., :3, 3] = coefficients[..., :3]
    matrices[..., 3, 3] = 1.0
    return matrices


def matrix_coefficients(matrices: FloatArray) -> FloatArray:
    """(..., 9) coefficients of (..., 4, 4) matrices without shear; the inverse of `coefficient_matrices`.

    A mirrored matrix (negative determinant) gives a negative sx. Where rx is +-90 degrees, rz takes the whole turn.
    Shear is lost: compare ``coefficient_matrices(result)`` with the input where it may occur.
    """
    matrices = np.asarray(matrices, dtype=np.float64)
    scale = np.linalg.norm(matrices[..., :3, :3], axis=-2)
    scale[..., 0] *= np.where(np.linalg.det(matrices[..., :3, :3]) < 0, -1.0, 1.0)
    R = matrices[..., :3, :3] / np.where(scale == 0, 1.0, scale)[..., None, :]
    sin_x = np.clip(R[..., 2, 1], -1.0, 1.0)
    locked = np.abs(sin_x) > 1 - 1e-12
    rx = np.arcsin(sin_x)
    ry = np.where(locked, 0.0, np.arctan2(-R[..., 2, 0], R[..., 2, 2]))
    rz = np.where(locked, np.arctan2(R[..., 1, 0], R[..., 0, 0]), np.arctan2(-R[..., 0, 1], R[..., 1, 1]))
    return np.concatenate([matrices[..., :3, 3], np.stack([rx, ry, rz], axis=-1), scale], axis=-1)


def coefficient_derivatives(coefficients: FloatArray) -> FloatArray:
    """(..., 9, 4, 4) derivatives of `coefficient_matrices` by each of the (..., 9) coefficients."""
    coefficients = np.asarray(coefficients, dtype=np.float64)
    derivatives = np.zeros((*coefficients.shape[:-1], 9, 4, 4))
    angles, scales = coefficients[..., 3:6], coefficients[..., 6:9]
    whole = _rotation(angles)
    for axis in range(3):
        derivatives[..., axis, axis, 3] = 1.0
        derivatives[..., 3 + axis, :3, :3] = _rotation(angles, (axis,)) * scales[..., None, :]
        derivatives[..., 6 + axis, :3, axis] = whole[..., :, axis]
    return derivatives


def coefficient_gradient(coefficients: FloatArray, by_matrix: FloatArray) -> FloatArray:
    """(..., 9) derivatives by (..., 9) coefficients of what has (..., 4, 4) by their matrices.

    With F the (3, 3) derivatives by ``R S``, a turn about a unit axis a has the derivative ``a . q`` with the torque
    ``q_i = sum_jk e_ijk (F (R S)^T)_kj``. Each angle turns about one axis: z the world's, x the one z left, y the
    joint's own in the end.
    """
    angles, linear = coefficients[..., 3:6], by_matrix[..., :3, :3]
    rotation = _rotation(angles)
    moments = linear @ np.swapaxes(rotation * coefficients[..., None, 6:9], -1, -2)
    torque = np.stack(
        [moments[..., (i + 2) % 3, (i + 1) % 3] - moments[..., (i + 1) % 3, (i + 2) % 3] for i in range(3)]
    )
    by_x = np.cos(angles[..., 2]) * torque[0] + np.sin(angles[..., 2]) * torque[1]
    by_y = (np.moveaxis(rotation[..., 1], -1, 0) * torque).sum(axis=0)
    by_angle = np.stack([by_x, by_y, torque[2]], axis=-1)
    return np.concatenate([by_matrix[..., :3, 3], by_angle, (rotation * linear).sum(axis=-2)], axis=-1)


def coefficient_curvatures(coefficients: FloatArray) -> FloatArray:
    """(..., 9, 9, 4, 4) second derivatives of `coefficient_matrices`."""
    coefficients = np.asarray(coefficients, dtype=np.float64)
    curvatures = np.zeros((*coefficients.shape[:-1], 9, 9, 4, 4))
    angles, scales = coefficients[..., 3:6], coefficients[..., 6:9]
    for first in range(3):
        turned = _rotation(angles, (first,))
        for axis in range(3):
            curvatures[..., 3 + first, 6 + axis, :3, axis] = turned[..., :, axis]
            curvatures[..., 6 + axis, 3 + first, :3, axis] = turned[..., :, axis]
        for second in range(first, 3):
            both = _rotation(angles, (first, second)) * scales[..., None, :]
            curvatures[..., 3 + first, 3 + second, :3, :3] = both
            curvatures[..., 3 + second, 3 + first, :3, :3] = both
    return curvatures


def _rotation(angles: FloatArray, by: tuple[int, ...] = ()) -> FloatArray:
    """(..., 3, 3) matrices Rz Rx Ry of (..., 3) angles rx, ry, rz, differentiated once `by` each of these angles."""
    x, y, z = (_turn(angles[..., axis], axis, by.count(axis)) for axis in range(3))
    return np.asarray(z @ x @ y)


def _turn(angle: FloatArray, axis: int, order: int) -> FloatArray:
    """(..., 3, 3) rotation about an axis, or its derivative of an order: the plane's part a quarter turn on."""
    ahead = angle + order * (np.pi / 2)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((*angle.shape, 3, 3))
    matrices[..., axis, axis] = order == 0
    matrices[..., first, first] = matrices[..., second, second] = np.cos(ahead)
    matrices[..., second, first] = np.sin(ahead)
    matrices[..., first, second] = -matrices[..., second, first]
    return matrices


def coefficients_of(values: Mapping[str, float], joints: Sequence[str], names: Sequence[str]) -> FloatArray | None:
    """(j, 9) bone coefficients of ``joint:channel`` -> value; None where there are none.

    :param joints: paths, and the source's `names` of each
    :raises InputError: an unknown or ambiguous joint, or an unknown channel
    """
    if not values:
        return None
    coefficients = rest_coefficients(len(joints))
    for name, value in values.items():
        joint, _, channel = name.rpartition(":")
        place = find_joint(joint, joints, names, f"--bone {name}")
        if channel not in CHANNELS:
            raise InputError(f"--bone {name}", f"channel '{channel}', expected one of {' '.join(CHANNELS)}")
        coefficients[place, CHANNELS.index(channel)] = value
    return coefficients
