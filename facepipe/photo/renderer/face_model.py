"""A whole face, from sliders to an image, differentiable in all that goes in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from scipy import sparse
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.core.images import open_image, pixels
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import triangulate
from facepipe.parts import FaceParts, Material, TextureInput
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.light import KeyLight, shade
from facepipe.photo.renderer.rasterise import (
    Outline,
    Raster,
    antialias,
    barycentrics,
    facing,
    interpolate,
    rasterise,
    take,
)
from facepipe.rig import Rig, build
from facepipe.rig.torch.rig import DifferentiableRig, FixedMatrix

_Wrap = Literal["repeat", "mirror", "clamp"]


class PointNormals:
    """Unit normals of the points of one topology, area-weighted, as `facepipe.geometry.polygons.point_normals`."""

    def __init__(self, triangles: IntArray, point_count: int, *, dtype: torch.dtype = torch.float32) -> None:
        """:param triangles: (t, 3) point numbers, counter-clockwise outside"""
        triangles = np.asarray(triangles, dtype=np.int64)
        owners = np.repeat(np.arange(len(triangles)), 3)
        entries = (np.ones(len(owners)), (triangles.ravel(), owners))
        incidence = sparse.csr_array(entries, shape=(point_count, len(triangles)))
        self._triangles = torch.as_tensor(triangles)
        self._incidence = FixedMatrix(incidence, dtype, "cpu")

    def __call__(self, points: Tensor) -> Tensor:
        """(n, 3) unit normals of points (n, 3); (0, 1, 0) at points of no triangle with an area."""
        corners = take(points, self._triangles)
        areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = self._incidence @ areas
        square = (summed * summed).sum(dim=1, keepdim=True)
        flat = square < torch.finfo(square.dtype).tiny
        up = summed.new_tensor([0.0, 1.0, 0.0])
        return torch.where(flat, up, summed / torch.where(flat, torch.ones_like(square), square).sqrt())


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Triangles of all meshes, points numbered in mesh order."""

    triangles: IntArray  # (t, 3) point numbers, counter-clockwise outside
    materials: IntArray  # (t,) into `names`
    names: tuple[str, ...]  # of the materials; "" for surfaces without one
    colors: FloatArray  # (m, 3) linear, of each material; (1, 1, 1) where it has a texture
    textures: tuple[TextureInput | None, ...]  # (m,) diffuse textures
    uv: FloatArray  # (u, 2) texture coordinates, v up
    uv_corners: IntArray  # (t, 3) rows of `uv`


def opaque_surfaces(parts: FaceParts) -> Surfaces:
    """Everything with an opacity of 1; what lets light through, like corneas and lashes on cards, is left out.

    :raises TopologyError: a mesh refers to materials that are not there
    """
    materials = (Material(name=""), *parts.materials)
    number = {material.name: i for i, material in enumerate(materials)}
    pieces = []
    uv: list[FloatArray] = [np.zeros((1, 2))]
    first = 0
    for mesh in parts.meshes:
        corners, faces = triangulate(mesh.face_vertex_counts)
        of_face = np.zeros(len(mesh.face_vertex_counts), dtype=np.int64)
        bound = [(each.material, np.asarray(each.faces, dtype=np.int64)) for each in mesh.material_faces]
        for name, those in [(mesh.material or "", np.arange(len(of_face))), *bound]:
            if name not in number:
                raise TopologyError(mesh.name, f"material '{name}' is not among the face's materials")
            of_face[those] = number[name]
        chosen = of_face[faces]
        opaque = np.array([material.opacity == 1.0 for material in materials])[chosen]
        corners, chosen = corners[opaque], chosen[opaque]
        points = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
        rows = np.zeros(corners.shape, dtype=np.int64)  # row 0 where no texture is
        for uv_set in mesh.uv_sets:
            used = [
                i
                for i, one in enumerate(materials)
                if isinstance(one.diffuse_color, TextureInput) and one.diffuse_color.uv_set == uv_set.name
            ]
            shown = np.isin(chosen, used)
            within = points if uv_set.indices is None else np.asarray(uv_set.indices, dtype=np.int64)[corners]
            rows[shown] = within[shown] + sum(map(len, uv))
            uv.append(np.asarray(uv_set.values, dtype=np.float64))
        pieces.append((points + first, chosen, rows))
        first += len(mesh.points)
    pieces.append((np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.int64)))
    triangles, of_triangle, uv_corners = (np.concatenate(column) for column in zip(*pieces, strict=True))
    textures = tuple(one.diffuse_color if isinstance(one.diffuse_color, TextureInput) else None for one in materials)
    plain = [(1.0, 1.0, 1.0) if isinstance(one.diffuse_color, TextureInput) else one.diffuse_color for one in materials]
    return Surfaces(
        triangles=triangles,
        materials=of_triangle,
        names=tuple(material.name for material in materials),
        colors=np.array(plain, dtype=np.float64),
        textures=textures,
        uv=np.concatenate(uv),
        uv_corners=uv_corners,
    )


def bilinear(texels: Tensor, uv: Tensor, wrap_s: _Wrap = "repeat", wrap_t: _Wrap = "repeat") -> Tensor:
    """(m, c) values of texels (h, w, c), top row first, at UVs (m, 2) with v up.

    The same lookup as the pictures of `facepipe.pictures`: texel centres are half a texel inside.
    """
    height, width, channels = texels.shape
    x = uv[:, 0] * width - 0.5
    y = (1 - uv[:, 1]) * height - 0.5
    left, above = x.detach().floor(), y.detach().floor()
    fx, fy = (x - left)[:, None], (y - above)[:, None]
    columns = [_wrap(left.long() + step, width, wrap_s) for step in (0, 1)]
    rows = [_wrap(above.long() + step, height, wrap_t) * width for step in (0, 1)]
    flat = texels.reshape(-1, channels)
    upper, lower = (
        torch.lerp(take(flat, row + columns[0]), take(flat, row + columns[1]), fx.expand(-1, channels)) for row in rows
    )
    return torch.lerp(upper, lower, fy.expand(-1, channels))


def _wrap(index: Tensor, size: int, mode: _Wrap) -> Tensor:
    if mode == "clamp":
        return index.clamp(0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return torch.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size


class SurfaceColors:
    """Linear diffuse colours: one a material, or a texture."""

    def __init__(self, surfaces: Surfaces, largest: int, dtype: torch.dtype) -> None:
        """
        :param largest: pixels a side beyond which textures are halved
        :raises InputError: a texture that can't be read as an image
        """
        self.names = surfaces.names
        self.colors = torch.as_tensor(surfaces.colors, dtype=dtype)
        self.textures: dict[str, Tensor] = {}
        self._inputs = {
            i: source for i, source in enumerate(surfaces.textures) if source and (surfaces.materials == i).any()
        }
        for i, source in self._inputs.items():
            # (h, w, 3) linear colours of a texture's input, top row first: 8-bit sRGB decoded (IEC 61966-2-1)
            where = f"texture {source.texture.name}"
            image = open_image(source.texture.image(), where)
            texels = pixels(image, "RGB", where, max(1, max(image.size) // max(largest, 1)))
            table = from_srgb(np.arange(256) / 255.0)
            self.textures[self.names[i]] = torch.as_tensor(
                np.asarray((table[texels] * source.scale[:3] + source.bias[:3]).astype(np.float32)), dtype=dtype
            )
        self.materials = torch.as_tensor(surfaces.materials)
        self._uv = torch.as_tensor(surfaces.uv, dtype=dtype)
        self._corners = torch.as_tensor(surfaces.uv_corners)

    def __call__(
        self, raster: Raster, weights: Tensor, tint: Tensor | None = None, textures: Mapping[str, Tensor] | None = None
    ) -> Tensor:
        """(p, 3) colours at the covered pixels.

        :param weights: (p, 3) barycentric coordinates
        :param tint: (m, 3) what the colour of each material is multiplied by
        :param textures: (h, w, 3) linear texels instead of a material's own, by its name
        """
        material = self.materials[raster.triangles]
        result = take(self.colors if tint is None else self.colors * tint, material)
        images = {**self.textures, **(textures or {})}
        uv, places, shown = interpolate(self._uv, self._corners, raster, weights), [], []
        for number, source in self._inputs.items():
            pixels = (material == number).nonzero()[:, 0]
            if len(pixels):
                image = images[self.names[number]]
                shown.append(bilinear(image, uv.index_select(0, pixels), source.wrap_s, source.wrap_t))
                places.append(pixels)
        if not shown:
            return result
        return result * torch.ones_like(result).index_copy(0, torch.cat(places), torch.cat(shown))


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
        rig: Rig | None = None,
        drawn_only: bool = False,
        expressions_last: bool = False,
        largest_texture: int = 1024,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """
        :param rig: of these parts, where there is one already
        :param drawn_only: without points of no opaque triangle, as of hair: a third of those of the head in the box
        :param expressions_last: as for `DifferentiableRig`
        :param largest_texture: pixels a side beyond which textures are halved
        :raises InputError: a texture that can't be read, or a slider of joints or shapes that are not there
        :raises TopologyError: indices, counts or materials that don't fit
        """
        rig, surfaces = build(parts) if rig is None else rig, opaque_surfaces(parts)
        if drawn_only:
            used, triangles = np.unique(surfaces.triangles, return_inverse=True)
            rig, surfaces = rig.part(used), replace(surfaces, triangles=triangles.reshape(-1, 3))
        self.rig = DifferentiableRig(
            rig, parts.sliders, network=parts.slider_network, expressions_last=expressions_last, dtype=dtype
        )
        self.colors = SurfaceColors(surfaces, largest_texture, dtype)
        self.outline = Outline.from_triangles(surfaces.triangles, len(rig.points))
        self.normals = PointNormals(surfaces.triangles, len(rig.points), dtype=dtype)

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
        normals = self.normals(points) @ camera.matrix.mT
        normals = interpolate(normals, triangles, raster, weights) * facing(screen, triangles, raster)
        shadow = None if look.shadow is None else interpolate(look.shadow, triangles, raster, weights)
        normals = normalize(normals, dim=1)  # interpolated ones are shorter than 1 between points
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
