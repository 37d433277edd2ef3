"""Materials where samples lie: constants, textures filtered for their size on the picture, normal maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, IntArray
from facepipe.geometry.rasterise import interpolated
from facepipe.parts import Material, Texture, TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.scene import Scene

T = TypeVar("T")

CLAY = (0.50, 0.40, 0.345)  # linear; a face without a material
_MATT = 0.4  # roughness from which something see-through is a loose cover, no clear medium with a gloss
_CUT = 0.02  # opacity in a texture below which nothing is there
_STRANDS = 0.25  # of the highlights of a flat card: the hairs on it are round
_THROUGH = 0.35  # share of the light that hairs pass on to those below them
_FARTHEST_UV = np.float32(1e6)
_STRETCH = 4.0  # at most, of the longer way of a pixel's texels against the average
_PLAIN = Material(name="", diffuse_color=CLAY)
_NUMBERS = {  # and their values without a texture
    "metallic": 0.0,
    "roughness": 0.5,
    "opacity": 1.0,
    "occlusion": 1.0,
    "clearcoat": 0.0,
    "clearcoat_roughness": 0.01,
}
_TEXTURED = ("diffuse_color", "emissive_color", *_NUMBERS, "normal")


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """The surface at samples, m of them."""

    base: Float32Array  # (m, 3) linear colour
    emission: Float32Array  # (m, 3)
    metallic: Float32Array  # (m,)
    roughness: Float32Array  # (m,)
    opacity: Float32Array  # (m,)
    presence: Float32Array  # (m,) how much of it reflects: opacity cuts, but where the surface is smooth and clear
    gloss: Float32Array  # (m,) factor of highlights
    through: Float32Array  # (m,) share of the light that comes even where something stands before it
    occlusion: Float32Array  # (m,)
    coat: Float32Array  # (m,) how much of a clear layer lies over it
    coat_roughness: Float32Array  # (m,)
    mirror: Float32Array  # (m, 3) share of light reflected at normal incidence
    normals: Float32Array  # (m, 3) camera axes, to the outside


class Materials:
    """The materials of a scene as one camera sees them."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self._scene, self._camera = scene, camera
        self._each = [surface.material or _PLAIN for surface in scene.surfaces]
        uv_sets = {one.uv_set for material in self._each for one in _inputs(material)}
        self._layouts = {name: _layout(scene, camera, name) for name in uv_sets}

    def textures(self, surfaces: IntArray) -> list[Texture]:
        """What some surfaces read of textures, each once; nothing by UV sets that their meshes lack."""
        textures: dict[Texture, None] = {}
        for number in surfaces:
            names = {uv_set.name for uv_set in self._scene.surfaces[number].mesh.uv_sets}
            textures |= {one.texture: None for one in _inputs(self._each[number]) if one.uv_set in names}
        return list(textures)

    def at(self, ids: IntArray, weights: Float32Array, normals: Float32Array, colors: Float32Array) -> Surfaces:
        """The surface at barycentrics (m, 3) in triangles `ids` (m,).

        :param normals: (m, 3) unit, camera axes, to the outside
        :param colors: (m, 3) the points' own
        """
        kind = self._scene.surface[ids]
        table = self._table[kind]
        opacity = self.opacity(ids, weights)
        surfaces = Surfaces(
            base=table[:, 0:3] * np.where(self._colored[kind, None], colors, 1.0).astype(np.float32),
            emission=table[:, 3:6].copy(),
            metallic=table[:, 6].copy(),
            roughness=table[:, 7].copy(),
            opacity=opacity,
            presence=np.maximum(opacity, 1 - table[:, 7] / _MATT),
            gloss=np.ones(len(ids), np.float32),
            through=np.zeros(len(ids), np.float32),
            occlusion=table[:, 9].copy(),
            coat=table[:, 10].copy(),
            coat_roughness=table[:, 11].copy(),
            mirror=np.repeat(table[:, 12:], 3, axis=1),
            normals=normals.copy(),
        )
        for number, material in enumerate(self._each):
            if _inputs(material):
                at = np.flatnonzero(kind == number)
                self._look_up(number, surfaces, at, ids[at], weights[at])
        metal = surfaces.metallic[:, None]
        surfaces.mirror[:] += (surfaces.base - surfaces.mirror) * metal
        return surfaces

    def opacity(self, ids: IntArray, weights: Float32Array) -> Float32Array:
        """(m,) opacity alone."""
        kind = self._scene.surface[ids]
        opacity: Float32Array = self._table[kind, 8]
        for number, material in enumerate(self._each):
            if isinstance(material.opacity, TextureInput):
                at = np.flatnonzero(kind == number)
                read = self._read(material.opacity, ids[at], weights[at], whole=material.opacity_threshold > 0)
                if read is not None:
                    opacity[at] = _cut(read[0][:, 0], material.opacity_threshold, read[1])
        return opacity

    def _look_up(self, number: int, surfaces: Surfaces, at: IntArray, ids: IntArray, weights: Float32Array) -> None:
        """Overwrite what the textures of one surface say at the samples numbered `at`."""
        material = self._each[number]
        targets = {
            "diffuse_color": surfaces.base,
            "emissive_color": surfaces.emission,
            "metallic": surfaces.metallic[:, None],
            "roughness": surfaces.roughness[:, None],
            "occlusion": surfaces.occlusion[:, None],
            "clearcoat": surfaces.coat[:, None],
            "clearcoat_roughness": surfaces.coat_roughness[:, None],
        }
        for name, target in targets.items():
            source = getattr(material, name)
            read = self._read(source, ids, weights) if isinstance(source, TextureInput) else None
            if read is not None:
                target[at] = np.clip(read[0], 0.0, 1.0)
        if isinstance(material.opacity, TextureInput):
            matt = np.minimum(surfaces.roughness[at] / _MATT, 1)
            surfaces.presence[at] = np.maximum(
                surfaces.opacity[at], (1 - matt) * np.minimum(surfaces.opacity[at] / _CUT, 1)
            )
            surfaces.gloss[at] = 1 - (1 - _STRANDS) * matt
            surfaces.through[at] = _THROUGH * matt
        if material.normal is not None:
            self._bend(_as_normals(material.normal), surfaces, at, ids, weights)

    def _read(
        self, source: TextureInput, ids: IntArray, weights: Float32Array, *, color: bool = True, whole: bool = False
    ) -> tuple[Float32Array, Float32Array] | None:
        """Values (m, c), and how many texels a pixel spans (m,); None where the mesh lacks the UV set.

        :param whole: of all texels in a pixel, as many as it spans its longer way; else as on average of both ways
        """
        layout = self._layouts[source.uv_set]
        corners = layout.corners[ids]
        if len(ids) == 0 or np.isnan(corners[0, 0, 0]):
            return None
        uv = interpolated((corners[:, 0], corners[:, 1], corners[:, 2]), weights)
        footprint = layout.longest if whole else layout.footprint
        return self._scene.textures.sample(source, uv, footprint[ids], color=color)

    def _bend(
        self, source: TextureInput, surfaces: Surfaces, at: IntArray, ids: IntArray, weights: Float32Array
    ) -> None:
        """Turn normals by a normal map; where a pixel spans many of its bumps, roughen the surface instead."""
        read = self._read(source, ids, weights, color=False)
        if read is None:
            return
        texel, layout = read[0], self._layouts[source.uv_set]
        outward = surfaces.normals[at]
        bent = layout.along[ids] * texel[:, :1] + layout.across[ids] * texel[:, 1:2]
        bent += outward * (np.maximum(texel[:, 2], 0.05) - np.einsum("mc,mc->m", bent, outward))[:, None]
        surfaces.normals[at] = _unit(bent)
        # Toksvig 2005: averaged normals are shorter, by as much as they vary.
        length = np.clip(np.sqrt(np.einsum("mc,mc->m", texel, texel)), 0.5, 1.0)
        surfaces.roughness[at] = np.minimum((surfaces.roughness[at] ** 4 + (1 - length) / length) ** 0.25, 1.0)

    @cached_property
    def _table(self) -> Float32Array:
        """(surfaces, 13): base and emitted colour, `_NUMBERS`, mirror; where they are constant."""
        rows = []
        for material, colored in zip(self._each, self._colored, strict=True):
            base = (1.0, 1.0, 1.0) if colored else _constant(material.diffuse_color, CLAY)
            emitted = _constant(material.emissive_color, (0.0, 0.0, 0.0))
            numbers = [_constant(getattr(material, name), default) for name, default in _NUMBERS.items()]
            rows.append((*base, *emitted, *numbers, ((material.ior - 1) / (material.ior + 1)) ** 2))
        return np.array(rows, np.float32).reshape(-1, 13)

    @cached_property
    def _colored(self) -> BoolArray:
        """(surfaces,) whether the points' own colours count: they stand for a constant colour, not for a texture."""
        own = (surface.mesh.colors is not None for surface in self._scene.surfaces)
        textured = (isinstance(material.diffuse_color, TextureInput) for material in self._each)
        return np.array([a and not b for a, b in zip(own, textured, strict=True)], dtype=bool)


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """How one UV set lies on the triangles."""

    corners: Float32Array  # (t, 3, 2), NaN where the mesh lacks it
    footprint: Float32Array  # (t,) length in UV space that a pixel spans
    longest: Float32Array  # (t,) the same the way that it spans most, and `_STRETCH` of that at most
    along: Float32Array  # (t, 3) unit tangents in camera axes: the way that u grows
    across: Float32Array  # (t, 3) and v


def _layout(scene: Scene, camera: Camera, uv_set: str) -> _Layout:
    # a damaged file's UVs can be beyond what float32 multiplies; at a million it holds no part of a texture any more
    corners = np.clip(scene.uv_corners(uv_set), -_FARTHEST_UV, _FARTHEST_UV)
    (u1, v1), (u2, v2) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    area = u1 * v2 - u2 * v1
    first, second, third = (camera.to_camera(scene.points)[each].astype(np.float32) for each in scene.triangles.T)
    depth = np.maximum(-first[:, 2], 1e-6)
    p1, p2 = second - first, third - first
    facing = np.abs(np.einsum("tc,tc->t", np.cross(p1, p2), first)) / depth
    pixels = np.maximum(facing * (camera.focal / depth) ** 2, 1e-6)
    footprint = np.sqrt(np.abs(area) / pixels)
    (x1, y1), (x2, y2) = p1[:, :2].T, p2[:, :2].T
    right, down = np.hypot(u1 * y2 - u2 * y1, v1 * y2 - v2 * y1), np.hypot(u2 * x1 - u1 * x2, v2 * x1 - v1 * x2)
    longest = np.maximum(right, down) / np.maximum(np.abs(x1 * y2 - x2 * y1), 1e-12) * depth / camera.focal
    sign = np.where(area < 0, np.float32(-1), np.float32(1))[:, None]
    along = (p1 * v2[:, None] - p2 * v1[:, None]) * sign
    across = (p2 * u1[:, None] - p1 * u2[:, None]) * sign
    return _Layout(
        corners=corners,
        footprint=footprint,
        longest=np.clip(longest, footprint, _STRETCH * footprint),
        along=_unit(along),
        across=_unit(across),
    )


def _inputs(material: Material) -> list[TextureInput]:
    """What a material reads from textures."""
    values = (getattr(material, name) for name in _TEXTURED)
    return [value for value in values if isinstance(value, TextureInput)]


def _as_normals(source: TextureInput) -> TextureInput:
    """The input as vectors: files that don't author scale and bias mean 2 and -1."""
    if source.scale[:2] != (1.0, 1.0):
        return source
    return replace(source, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))


def _cut(opacity: Float32Array, threshold: float, texels: Float32Array) -> Float32Array:
    """Opacities as they are, or cut at a threshold with an edge of a pixel at most, and of half a texel."""
    if threshold <= 0:
        return np.clip(opacity, 0.0, 1.0)
    return np.clip((opacity - threshold) / np.clip(texels, 0.02, 0.5) + 0.5, 0.0, 1.0)


def _constant(value: T | TextureInput, otherwise: T) -> T:
    return otherwise if isinstance(value, TextureInput) else value


def _unit(vectors: Float32Array) -> Float32Array:
    length = np.sqrt(np.einsum("mc,mc->m", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, 1e-12)[:, None], np.float32)
