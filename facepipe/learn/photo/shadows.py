"""What a face keeps from light in one photo."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.learn.camera import Camera, rotation_matrices
from facepipe.learn.face_model import FaceModel
from facepipe.learn.light import KERNEL
from facepipe.learn.self_shadow import shadow_transfer, visibility

_SHARP = 448  # pixels a side of a lamp's view


@dataclass(frozen=True, kw_only=True)
class Shadows:
    """Of each point, without gradients: a face that moves a little keeps them, one that moves far needs new ones."""

    transfer: Tensor  # (n, 9) as `Look.shadow`
    arriving: Tensor  # (n,) as `KeyLight.arriving`

    @classmethod
    def of(cls, model: FaceModel, points: Tensor, camera: Camera, lamp: Tensor) -> Shadows:
        """Those of world points (n, 3) for a lamp (8,) as `KeyLight`."""
        transfer = shadows_of_harmonics(model, points, camera)
        return cls(transfer=transfer, arriving=shadows_of_lamp(model, points, camera, lamp))


def shadows_of_harmonics(model: FaceModel, points: Tensor, camera: Camera) -> Tensor:
    """(n, 9) as `Look.shadow`, of world points (n, 3)."""
    with torch.no_grad():
        turn = rotation_matrices(camera.rotation).mT
        transfer = shadow_transfer(points @ turn, model.normals(points) @ turn, model.outline.triangles)
        return transfer * transfer.new_tensor(KERNEL)  # a window: nine harmonics of sharp shadows ring


def shadows_of_lamp(model: FaceModel, points: Tensor, camera: Camera, lamp: Tensor) -> Tensor:
    """(n,) as `KeyLight.arriving`, of world points (n, 3) and a lamp (8,); of a dark one nothing: it stays dark."""
    with torch.no_grad():
        if not bool((lamp[3:6] > 0).any()):
            return points.new_zeros(len(points))
        local = camera.to_camera(points)
        return visibility(local, model.outline.triangles, normalize(lamp[:3], dim=0), _SHARP)
