"""Transforms as translation, rotation, scale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.parts import Skeleton

_SHEAR_TOLERANCE = 1e-6


class Trs(NamedTuple):
    """Translation, unit quaternion x y z w and scale of (..., 4, 4) matrices, and which of them have shear."""

    translation: FloatArray
    rotation: FloatArray
    scale: FloatArray
    sheared: BoolArray


def compose(translations: FloatArray, rotations: FloatArray, scales: FloatArray) -> FloatArray:
    """(..., 4, 4) matrices T R S of (..., 3), (..., 4) quaternions x y z w, normalised first, and (..., 3)."""
    linear = rotation_matrices(rotations) * np.asarray(scales, dtype=np.float64)[..., None, :]
    matrices = np.zeros((*linear.shape[:-2], 4, 4))
    matrices[..., :3, :3] = linear
    matrices[..., :3, 3] = translations
    matrices[..., 3, 3] = 1.0
    return matrices


def decompose(matrices: FloatArray) -> Trs:
    """TRS of affine (..., 4, 4) matrices; a mirrored one gets a negative x scale, a sheared one its nearest TRS."""
    matrices = np.asarray(matrices, dtype=np.float64)
    linear = matrices[..., :3, :3]
    scale = np.linalg.norm(linear, axis=-2)
    scale[..., 0] *= np.where(np.linalg.det(linear) < 0, -1.0, 1.0)
    flat = np.abs(scale).min(axis=-1) <= 1e-9 * np.abs(scale).max(axis=-1)
    rotation = linear / np.where(scale == 0, 1.0, scale)[..., None, :]
    gram = np.swapaxes(rotation, -1, -2) @ rotation
    skewed = flat | (np.abs(gram - np.eye(3)).max(axis=(-1, -2)) > _SHEAR_TOLERANCE)
    if skewed.any():
        # with a shear, columns over their lengths are no rotation: the nearest (polar decomposition), and its scales
        bent = linear[skewed]
        U, _, Vt = np.linalg.svd(bent)
        sign = np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)
        mirror = np.eye(3) * np.stack([sign, np.ones_like(sign), np.ones_like(sign)], axis=-1)[..., None, :]
        nearest = U @ Vt @ mirror
        rotation[skewed], scale[skewed] = nearest, np.einsum("...ij,...ij->...j", nearest, bent)
    rebuilt = rotation * scale[..., None, :]
    size = np.abs(linear).max(axis=(-1, -2))
    sheared = np.abs(rebuilt - linear).max(axis=(-1, -2)) > _SHEAR_TOLERANCE * np.where(size == 0, 1.0, size)
    return Trs(matrices[..., :3, 3], quaternions(rotation), scale, np.asarray(sheared))


def rest_worlds(skeleton: Skeleton) -> FloatArray:
    """(j, 4, 4) joints at rest in skeleton space."""
    rest = np.asarray(skeleton.rest_transforms, dtype=np.float64)
    return accumulate(rest, skeleton.parents)


def accumulate(local: FloatArray, parents: IntArray) -> FloatArray:
    """Local matrices (..., j, 4, 4) times those of all their parents; parents come first."""
    worlds = np.array(local)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            worlds[..., joint, :, :] = worlds[..., parent, :, :] @ local[..., joint, :, :]
    return worlds


def quaternions(rotations: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions x y z w, w >= 0, of (..., 3, 3) rotation matrices (Shepperd's method)."""
    R = np.asarray(rotations, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    yz, zx, xy = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    sum_xy, sum_xz, sum_yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(
        [
            np.stack([1 + xx - yy - zz, sum_xy, sum_xz, yz], axis=-1),
            np.stack([sum_xy, 1 - xx + yy - zz, sum_yz, zx], axis=-1),
            np.stack([sum_xz, sum_yz, 1 - xx - yy + zz, xy], axis=-1),
            np.stack([yz, zx, xy, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    chosen = chosen * np.where(chosen[..., 3:] < 0, -1.0, 1.0)
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def slerp(a: FloatArray, b: FloatArray, share: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions between `a` and `b`, along the shorter arc.

    :param share: (..., 1), 0 at `a` and 1 at `b`
    """
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0.0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-6  # nearly equal rotations: their angle has no usable sine
    safe = np.where(near, 1.0, sine)
    from_a = np.where(near, 1.0 - share, np.sin((1.0 - share) * angle) / safe)
    from_b = np.where(near, share, np.sin(share * angle) / safe)
    return np.asarray(from_a * a + from_b * b)


def rotation_matrices(rotations: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices of (..., 4) quaternions x y z w, normalised first."""
    q = np.asarray(rotations, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
