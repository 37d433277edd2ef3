"""What the pixels of a photo show of a face whose points and camera are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.photo.renderer.camera import Camera, rotation_matrices
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.rasterise import Raster, barycentrics, facing, interpolate, rasterise

_SHOWN = 0.5


@dataclass(frozen=True, kw_only=True)
class SeenSurface:
    """The covered pixels, p of them, without gradients."""

    raster: Raster
    triangles: Tensor  # (t, 3) of the face
    weights: Tensor  # (p, 3) barycentric coordinates
    normals: Tensor  # (p, 3) unit, camera coordinates, towards the viewer's side
    towards_eye: Tensor  # (p, 3) unit
    colors: Tensor  # (p, 3) linear, of the face's own materials
    materials: Tensor  # (p,) numbers into the names of the face's colours

    @classmethod
    def from_camera(cls, model: FaceModel, points: Tensor, camera: Camera, face: Tensor) -> SeenSurface:
        """:param points: (n, 3) world points
        :param face: (h, w) share of face in each pixel of the picture that the camera is for: where it is little,
            something else covers the surface
        """
        with torch.no_grad():
            local, triangles = camera.to_camera(points), model.outline.triangles
            screen = camera.to_pixels(local)
            raster = rasterise(screen, triangles, *face.shape)
            shown = face.reshape(-1)[raster.pixels] > _SHOWN
            raster = replace(raster, pixels=raster.pixels[shown], triangles=raster.triangles[shown])
            weights = barycentrics(screen, triangles, raster)
            normals = model.normals(points) @ rotation_matrices(camera.rotation).mT
            normals = interpolate(normals, triangles, raster, weights) * facing(screen, triangles, raster)
            return cls(
                raster=raster,
                triangles=triangles,
                weights=weights,
                normals=normalize(normals, dim=1),
                towards_eye=normalize(-interpolate(local, triangles, raster, weights), dim=1),
                colors=model.colors(raster, weights),
                materials=model.colors.materials[raster.triangles],
            )

    def at_pixels(self, values: Tensor) -> Tensor:
        """(p, ...) what points (n, ...) have, interpolated."""
        flat = values if values.ndim > 1 else values[:, None]
        found = interpolate(flat, self.triangles, self.raster, self.weights)
        return found if values.ndim > 1 else found[:, 0]
