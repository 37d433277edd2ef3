"""From stage space to glTF space: metres, Y up, and transforms as translation, rotation, scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.parts import FaceParts, FloatArray

_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SHEAR_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Space:
    """Where the parts of a face go.

    `world` takes stage world space to glTF space; `skeleton` takes skeleton space there. A joint's local matrix L
    becomes ``axes L inverse(axes)``, a root's ``placement axes L inverse(axes)``: `axes` holds the units, the axis
    change and the skeleton's uniform scale, so that joints carry none of them.
    """

    world: FloatArray  # (4, 4)
    skeleton: FloatArray  # (4, 4)
    axes: FloatArray  # (4, 4), linear
    placement: FloatArray  # (4, 4)

    def local(self, matrices: FloatArray, is_root: npt.NDArray[np.bool_]) -> FloatArray:
        """(..., j, 4, 4) local joint matrices of the stage, as those of glTF nodes."""
        turned = self.axes @ matrices @ np.linalg.inv(self.axes)
        turned[..., is_root, :, :] = self.placement @ turned[..., is_root, :, :]
        return np.asarray(turned)

    def inverse_binds(self, bind_transforms: FloatArray) -> FloatArray:
        """(j, 4, 4) inverse bind matrices for vertices in glTF space."""
        return np.asarray(self.axes @ np.linalg.inv(bind_transforms) @ np.linalg.inv(self.skeleton))


def space_of(parts: FaceParts) -> Space:
    """The conversion of a face; its skeleton's transform must be invertible."""
    world = np.eye(4)
    turn = _Z_UP_TO_Y_UP if parts.up_axis == "Z" else np.eye(3)
    world[:3, :3] = turn * parts.meters_per_unit
    skeleton = world @ np.asarray(parts.skeleton.transform, dtype=np.float64)
    axes = np.eye(4)
    axes[:3, :3] = turn * np.cbrt(abs(np.linalg.det(skeleton[:3, :3])))
    return Space(world, skeleton, axes, skeleton @ np.linalg.inv(axes))


class Trs(NamedTuple):
    """Translation, unit quaternion x y z w and scale of (..., 4, 4) matrices, and which of them have shear."""

    translation: FloatArray
    rotation: FloatArray
    scale: FloatArray
    sheared: npt.NDArray[np.bool_]


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
        rotation[skewed], scale[skewed] = _nearest(linear[skewed])
    rebuilt = rotation * scale[..., None, :]
    size = np.abs(linear).max(axis=(-1, -2))
    sheared = np.abs(rebuilt - linear).max(axis=(-1, -2)) > _SHEAR_TOLERANCE * np.where(size == 0, 1.0, size)
    return Trs(matrices[..., :3, 3], quaternions(rotation), scale, np.asarray(sheared))


def _nearest(linear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nearest rotations (polar decomposition) and the scales that go with them."""
    U, _, Vt = np.linalg.svd(linear)
    sign = np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)
    mirror = np.eye(3) * np.stack([sign, np.ones_like(sign), np.ones_like(sign)], axis=-1)[..., None, :]
    rotation = U @ Vt @ mirror
    return rotation, np.einsum("...ij,...ij->...j", rotation, linear)


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


def numbers(values: Any) -> list[float]:
    """float32 values as JSON numbers, shortest form."""
    return [float(str(value)) + 0.0 for value in np.asarray(values, dtype=np.float32).ravel()]
