"""Where a face is seen from: pose, focal length and principal point to pixel positions, with gradients.

Camera coordinates are x right, y up, z towards the viewer, as in `facepipe.pictures`: the depth along the view is -z.
Pixels count from the top left corner of the image, x right and y down; the first pixel's centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray

NEAR = 1e-6  # smallest depth, in stage units, that counts as in front of the camera
_SMALL = 1e-4  # squared angle below which series stand for sines


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera, or a batch of them: ``camera point = R(rotation) world point + translation``."""

    rotation: Tensor  # (..., 3) rotation vector, radians
    translation: Tensor  # (..., 3) stage units
    focal: Tensor  # (...) pixels
    center: Tensor  # (..., 2) principal point, pixels

    @classmethod
    def at(
        cls,
        axes: FloatArray,
        eye: FloatArray,
        focal: float,
        center: tuple[float, float],
        *,
        dtype: torch.dtype = torch.float32,
    ) -> Camera:
        """The camera at `eye` (3,) whose right, up and backward axes in the world are the rows of `axes` (3, 3)."""
        from scipy.spatial.transform import Rotation

        axes = np.asarray(axes, dtype=np.float64)
        # A (x - eye) = A x + t, so t = -A eye.
        numbers = (Rotation.from_matrix(axes).as_rotvec(), -axes @ eye, focal, center)
        rotation, translation, length, middle = (
            torch.as_tensor(np.asarray(number, dtype=np.float64), dtype=dtype) for number in numbers
        )
        return cls(rotation=rotation, translation=translation, focal=length, center=middle)

    def to_camera(self, points: Tensor) -> Tensor:
        """(..., n, 3) camera coordinates of world points (..., n, 3)."""
        return points @ self.matrix.mT + self.translation[..., None, :]

    @cached_property
    def matrix(self) -> Tensor:
        """(..., 3, 3) R(rotation)."""
        return rotation_matrices(self.rotation)

    def project(self, points: Tensor) -> Tensor:
        """(..., n, 3) pixel x, pixel y and depth of world points (..., n, 3)."""
        return self.to_pixels(self.to_camera(points))

    def to_pixels(self, points: Tensor) -> Tensor:
        """(..., n, 3) pixel x, pixel y and depth of points in camera coordinates (..., n, 3).

        What is not in front of the camera has a depth below `NEAR`, and x and y without meaning.
        """
        depth = -points[..., 2]
        scale = self.focal[..., None] / torch.where(depth > NEAR, depth, torch.ones_like(depth))
        x = self.center[..., 0, None] + scale * points[..., 0]
        y = self.center[..., 1, None] - scale * points[..., 1]
        return torch.stack([x, y, depth], dim=-1)


def rotation_matrices(vectors: Tensor) -> Tensor:
    """(..., 3, 3) rotations of rotation vectors (..., 3), axis times angle in radians (Rodrigues), smooth at 0."""
    square = (vectors * vectors).sum(dim=-1)
    small = square < _SMALL
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    first = torch.where(small, 1 - square / 6 + square**2 / 120, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24 + square**2 / 720, 2 * (angle / 2).sin() ** 2 / safe)
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return eye + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)
