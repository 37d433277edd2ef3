"""A head's pose as an aligned crop of its face shows it, and as the whole photo has it.

Where in a photo a face is, how large and how tilted, is given by the crop's matrix alone. What is left for a network to
see are the seven numbers here: a turn away from facing the viewer along the line of sight (rotation vector), the head's
middle and the logarithm of its size in sides of the crop, and the logarithm of the distance in head heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.photo.descent.pose import PoseSpace

_SMALL = 1e-12


@dataclass(frozen=True, kw_only=True)
class CropSpace:
    """How poses relative to crops and those of their photo belong together; in torch, with gradients.

    Leading dimensions are a batch: of poses, or of crops of one photo with a pose each.
    """

    space: PoseSpace
    crop: FloatArray  # (..., 2, 3) from crop pixels to photo pixels
    side: int  # pixels a side of the crop
    up_axis: str  # of the face: Y or Z

    def to_photo(self, relative: Tensor) -> Tensor:
        """(..., 7) as `PoseSpace` of (..., 7) relative to the crop."""
        matrix = relative.new_tensor(self.crop)
        place = (matrix[..., :2] @ relative[..., 3:5, None])[..., 0] * self.side + matrix[..., 2]
        place = place / self.space.side
        scale = relative[..., 5] + self._log_scale(relative)
        sight = self._sight(place, scale + relative[..., 6])
        turn = _product(_product(sight, self._tilt(relative)), _from_vector(relative[..., :3]))
        rotation = _to_vector(_product(turn, self._front(relative)))
        return torch.cat([rotation, place, scale[..., None], relative[..., 6:]], dim=-1)

    def to_crop(self, pose: Tensor) -> Tensor:
        """(..., 7) relative to the crop of (..., 7) as `PoseSpace`."""
        matrix = pose.new_tensor(self.crop)
        sight = self._sight(pose[..., 3:5], pose[..., 5] + pose[..., 6])
        before = _inverse(_product(sight, self._tilt(pose)))
        turn = _product(_product(before, _from_vector(pose[..., :3])), _inverse(self._front(pose)))
        off = pose[..., 3:5] * self.space.side - matrix[..., 2]
        place = (torch.linalg.inv(matrix[..., :2]) @ off[..., None])[..., 0] / self.side
        size = pose[..., 5] - self._log_scale(pose)
        return torch.cat([_to_vector(turn), place, size[..., None], pose[..., 6:]], dim=-1)

    def _log_scale(self, like: Tensor) -> Tensor:
        """(...) logarithm of the crop's side in sides of the photo."""
        scale = np.hypot(self.crop[..., 0, 0], self.crop[..., 1, 0])
        return like.new_tensor(np.log(scale * self.side / self.space.side))

    def _tilt(self, like: Tensor) -> Tensor:
        """(..., 4) the crop's turn in the picture, whose y points down, about the view."""
        half = -np.arctan2(self.crop[..., 1, 0], self.crop[..., 0, 0]) / 2
        return like.new_tensor(np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1))

    def _front(self, like: Tensor) -> Tensor:
        """(4,) the turn that makes a face look at the viewer upright."""
        half = np.sqrt(0.5)
        return like.new_tensor([half, -half, 0.0, 0.0] if self.up_axis == "Z" else [1.0, 0.0, 0.0, 0.0])

    def _sight(self, place: Tensor, log_focal: Tensor) -> Tensor:
        """(..., 4) the turn from straight ahead to a place in the photo."""
        center = place.new_tensor(self.space.center) / self.space.side
        x, y = ((place - center) / log_focal.exp()[..., None]).unbind(-1)
        length = (x * x + y * y + 1).sqrt()
        half = torch.stack([length + 1, -y, -x, torch.zeros_like(x)], dim=-1)
        return half / torch.linalg.vector_norm(half, dim=-1, keepdim=True)


def _from_vector(vector: Tensor) -> Tensor:
    """(..., 4) unit quaternions, w first, of rotation vectors (..., 3), smooth at 0."""
    square = (vector * vector).sum(dim=-1, keepdim=True)
    small = square < 1e-6
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    share = torch.where(small, 0.5 - square / 48, (angle / 2).sin() / angle)
    real = torch.where(small, 1 - square / 8, (angle / 2).cos())
    return torch.cat([real, vector * share], dim=-1)


def _to_vector(quaternion: Tensor) -> Tensor:
    """(..., 3) rotation vectors up to pi of unit quaternions."""
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    real, vector = quaternion[..., :1], quaternion[..., 1:]
    square = (vector * vector).sum(dim=-1, keepdim=True)
    small = square < 1e-8
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    share = torch.where(small, 2 / real.clamp(min=_SMALL), 2 * torch.atan2(sine, real) / sine)
    return vector * share


def _product(one: Tensor, other: Tensor) -> Tensor:
    """Quaternions multiplied: the turn `other`, then `one`."""
    a, b, c, d = one.unbind(-1)
    w, x, y, z = other.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )


def _inverse(quaternion: Tensor) -> Tensor:
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)
