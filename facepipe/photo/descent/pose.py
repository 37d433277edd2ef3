"""A head's place in a photo in seven numbers that hardly depend on each other, and a first guess from landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.photo.renderer.camera import Camera, rotation_matrices

NUMBERS = 7  # rotation vector (3), middle of the head in pixels (2), log pixels per unit there, log distance
FOCAL = 2.6  # of the photo's larger side, about 94 mm on a 36 mm frame: portraits have long lenses, and are cropped


@dataclass(frozen=True, kw_only=True)
class PoseSpace:
    """How seven numbers stand for the camera of one photo.

    A head's middle in pixels, its size there and its turn are what a photo shows; how near it was taken is nearly
    hidden, and is the last number alone.
    """

    middle: FloatArray  # (3,) of the head in the world, stage units
    size: float  # head height, stage units
    center: tuple[float, float]  # principal point, pixels
    side: float  # larger side of the photo, pixels

    def camera(self, pose: Tensor) -> Camera:
        """The cameras of (..., 7) poses."""
        rotation = pose[..., :3]
        distance = self.size * torch.exp(pose[..., 6])
        focal = distance / self.size * torch.exp(pose[..., 5]) * self.side
        center = pose.new_tensor(self.center)
        offset = (pose[..., 3:5] * self.side - center) * (distance / focal)[..., None]
        place = torch.stack([offset[..., 0], -offset[..., 1], -distance], dim=-1)
        turned = (rotation_matrices(rotation) @ pose.new_tensor(self.middle)[:, None])[..., 0]
        return Camera(
            rotation=rotation,
            translation=place - turned,
            focal=focal,
            center=center.expand(*pose.shape[:-1], 2),
        )

    def log_focal(self, pose: FloatArray) -> FloatArray:
        """(...,) logarithms of the focal lengths over `side`."""
        return np.asarray(pose[..., 5] + pose[..., 6])

    def guess(self, points: FloatArray, pixels: FloatArray) -> FloatArray:
        """(7,) pose at which world points (n, 3) fall near pixels (n, 2), seen from far away.

        The affine camera in least squares, then the rotation next to it (DeMenthon and Davis, "Model-Based Object
        Pose in 25 Lines of Code", IJCV 1995, first step).
        """
        from scipy.spatial.transform import Rotation

        local = points - self.middle
        rows = np.column_stack([local, np.ones(len(local))])
        upright = np.column_stack([pixels[:, 0], -pixels[:, 1]])
        affine = np.linalg.lstsq(rows, upright, rcond=None)[0]
        x, y = affine[:3].T
        scale = float(np.sqrt(np.linalg.norm(x) * np.linalg.norm(y)))
        u, _, vt = np.linalg.svd(np.stack([x, y, np.cross(x, y) / max(scale, 1e-12)]))
        turn = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
        log_scale = np.log(max(scale, 1e-12) * self.size / self.side)
        at = affine[3] * (1, -1) / self.side
        return np.array([*Rotation.from_matrix(turn).as_rotvec(), *at, log_scale, np.log(FOCAL) - log_scale])
