"""Bone coefficients: 9 numbers a joint, relative to its rest transform (DESIGN section 7).

``M = T(t) Rz(rz) Rx(rx) Ry(ry) S(s)`` in column vectors, channels in the order of `CHANNELS`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]

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


def _rotation(angles: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices Rz Rx Ry of (..., 3) angles rx, ry, rz."""
    cx, cy, cz = np.moveaxis(np.cos(angles), -1, 0)
    sx, sy, sz = np.moveaxis(np.sin(angles), -1, 0)
    rows = [
        [cz * cy - sz * sx * sy, -sz * cx, cz * sy + sz * sx * cy],
        [sz * cy + cz * sx * sy, cz * cx, sz * sy - cz * sx * cy],
        [-cx * sy, sx, cx * cy],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def coefficient_derivatives(coefficients: FloatArray) -> FloatArray:
    """(..., 9, 4, 4) derivatives of `coefficient_matrices` by each of the (..., 9) coefficients."""
    coefficients = np.asarray(coefficients, dtype=np.float64)
    derivatives = np.zeros((*coefficients.shape[:-1], 9, 4, 4))
    angles, scales = coefficients[..., 3:6], coefficients[..., 6:9]
    whole = _rotation(angles)
    for axis in range(3):
        derivatives[..., axis, axis, 3] = 1.0
        derivatives[..., 3 + axis, :3, :3] = _by_angle(angles, axis) * scales[..., None, :]
        derivatives[..., 6 + axis, :3, axis] = whole[..., :, axis]
    return derivatives


def _by_angle(angles: FloatArray, axis: int) -> FloatArray:
    """(..., 3, 3) derivative of the rotation by one angle.

    The rotation is ``N + C cos + S sin`` in that angle: a quarter turn on, it is N plus the derivative, and N is the
    mean over any two opposite angles.
    """
    turn = np.eye(3)[axis] * np.pi
    return _rotation(angles + turn / 2) - 0.5 * (_rotation(angles) + _rotation(angles + turn))
