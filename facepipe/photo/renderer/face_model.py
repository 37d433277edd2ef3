"""A whole face, from sliders to an image, differentiable in all that goes in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.parts import FaceParts
from facepipe.photo.renderer.antialias import Outline, antialias
from facepipe.photo.renderer.camera import Camera, rotation_matrices
from facepipe.photo.renderer.light import KeyLight, shade
from facepipe.photo.renderer.rasterise import barycentrics, facing, interpolate, rasterise
from facepipe.photo.renderer.surfaces import PointNormals, SurfaceColors, opaque_surfaces
from facepipe.rig import build
from facepipe.rig.torch.rig import DifferentiableRig


@dataclass(frozen=True, kw_only=True)
class Look:
    """All of an image but the face's points."""

    camera: Camera
    light: Tensor  # (9, 3) spherical harmonics in camera coordinates
    background: Tensor  # (3,) or (height, width, 3) linear
    tint: Tensor | None = None  # (materials, 3) multiplies the materials' colours
    textures: Mapping[str, Tensor] | None = None  # material -> (h, w, 3) linear texels, instead of its own
    shadow: Tensor | None = None  # (n, 9) of each point, as `facepipe.photo.descent.shadows`; None: nothing shades
    key: KeyLight | None = None  # a lamp beside `light`


class FaceModel:
    """One face: sliders and shape weights to points, points to an image (photo-to-face-sliders [0203]-[0215])."""

    def __init__(
        self,
        parts: FaceParts,
        *,
        expressions_last: bool = False,
        largest_texture: int = 1024,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        """
        :param expressions_last: as for `DifferentiableRig`
        :param largest_texture: pixels a side beyond which textures are halved
        :raises InputError: a texture that can't be read, or a slider of joints or shapes that are not there
        :raises TopologyError: indices, counts or materials that don't fit
        """
        rig = build(parts)
        surfaces = opaque_surfaces(parts)
        self.rig = DifferentiableRig(
            rig,
            parts.sliders,
            network=parts.slider_network,
            expressions_last=expressions_last,
            dtype=dtype,
            device=device,
        )
        self.colors = SurfaceColors(surfaces, largest_texture, dtype, device)
        self.outline = Outline.from_triangles(surfaces.triangles, len(rig.points), device)
        self.normals = PointNormals(surfaces.triangles, len(rig.points), dtype=dtype, device=device)

    def __call__(
        self, sliders: Tensor | None, weights: Tensor | None, look: Look, *, height: int, width: int
    ) -> Tensor:
        """(height, width, 4) image of slider values (s,) and shape weights (shapes,); see `image`."""
        return self.image(self.rig(sliders, weights), look, height=height, width=width)

    def image(self, points: Tensor, look: Look, *, height: int, width: int) -> Tensor:
        """(height, width, 4) linear colour on the background, and coverage 0..1, of world points (n, 3).

        Normals are those of the posed points, smooth across each mesh; backs are lit as fronts are.
        """
        camera, triangles = look.camera, self.outline.triangles
        local = camera.to_camera(points)
        screen = camera.to_pixels(local)
        raster = rasterise(screen, triangles, height, width)
        weights = barycentrics(screen, triangles, raster)
        normals = self.normals(points) @ rotation_matrices(camera.rotation).mT
        normals = interpolate(normals, triangles, raster, weights) * facing(screen, triangles, raster)
        shadow = None if look.shadow is None else interpolate(look.shadow, triangles, raster, weights)
        normals = normalize(normals, dim=1)
        lit, albedo = shade(normals, look.light, shadow), self.colors(raster, weights, look.tint, look.textures)
        color = lit * albedo
        if look.key is not None:
            towards_eye = normalize(-interpolate(local, triangles, raster, weights), dim=1)
            arriving = interpolate(look.key.arriving[:, None], triangles, raster, weights)[:, 0]
            matt, mirrored = look.key.shade(normals, towards_eye, arriving)
            color = color + matt * albedo + mirrored
        values = torch.cat([color, torch.ones_like(color[:, :1])], dim=1)
        background = torch.cat([look.background, torch.zeros_like(look.background[..., :1])], dim=-1)
        return antialias(raster.paint(values, background), screen, self.outline, raster)
