"""What a sample of the scene shows: its material, heat map or paint, and the light on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.rasterise import barycentrics, interpolated
from facepipe.pictures.camera import Camera
from facepipe.pictures.columns import joined
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.lighting import EVEN, Lit, Samples, Studio
from facepipe.pictures.materials import Materials, Surfaces
from facepipe.pictures.occlusion import SHADOW_RESOLUTION, DepthMap, depth_map
from facepipe.pictures.photo_light import PhotoLights
from facepipe.pictures.portrait import PORTRAIT, Portrait
from facepipe.pictures.scene import Scene, Surface

INSIDE = 0.28  # how much light the inner side of a single-sided mesh gets
CHUNK = 20_000  # samples shaded at once
_PATTERN = np.array([0.06711056, 0.00583715]), 52.9829189  # interleaved gradient noise (Jimenez 2014)


@dataclass(frozen=True, kw_only=True)
class Shaded:
    """Samples with the light that leaves them, before the tones of the picture."""

    base: FloatArray  # (m, 3) linear colour
    lit: Lit
    key_light: FloatArray  # (m,) share of the key light that arrives
    scattered: FloatArray  # (m, 3) diffuse light that comes from below the surface, or goes there
    opacity: FloatArray  # (m,)
    presence: FloatArray  # (m,) how much of the surface is there: at least its opacity
    depth: FloatArray  # (m,) along the view

    @property
    def diffuse(self) -> FloatArray:
        """(m, 3) diffuse light on the surface."""
        return self.lit.diffuse + self.lit.key_diffuse * self.key_light[:, None]

    def toned(self, tone: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """(m, 3) colours of the picture, premultiplied by opacity.

        As in UsdPreviewSurface a see-through surface keeps its highlights whole: a clear cornea glints.
        """
        highlights = self.lit.highlights + self.lit.key_highlights * self.key_light[:, None]
        light = np.maximum(self.diffuse + self.scattered, 0)
        color = tone(self.base * light + highlights) * self.opacity[:, None]
        clear = np.flatnonzero(self.presence > self.opacity)
        if len(clear):
            color[clear] += tone(highlights[clear]) * (self.presence - self.opacity)[clear, None]
        return np.asarray(color, np.float32)


@dataclass(frozen=True)
class Shader:
    """Shades samples of one scene seen by one camera, at positions in its pixels."""

    scene: Scene
    camera: Camera
    heatmap: HeatMap | None = None
    paint: FloatArray | None = None  # (n, 3) linear colours per point instead of the materials'
    lights: Studio | Portrait | PhotoLights | None = None  # instead of those of `studio`

    @cached_property
    def studio(self) -> Studio | Portrait | PhotoLights:
        """The lights given; else even light where colours must be read, portrait light otherwise."""
        if self.lights is not None:
            return self.lights
        return PORTRAIT if self.heatmap is None and self.paint is None else EVEN

    @cached_property
    def homogeneous(self) -> FloatArray:
        """(n, 4) screen points of the camera."""
        return self.camera.project(self.scene.points)

    @cached_property
    def front(self) -> BoolArray:
        """(t,) triangles that turn their outside to the camera."""
        first = self.scene.points[self.scene.triangles[:, 0]]
        return np.asarray(np.einsum("tc,tc->t", self.scene.facets, self.camera.eye - first) > 0)

    @cached_property
    def unit_facets(self) -> Float32Array:
        """(t, 3) unit vectors across the triangles."""
        return _unit(self.scene.facets).astype(np.float32)

    @cached_property
    def materials(self) -> Materials:
        """The materials of the scene, read where samples lie."""
        return Materials(self.scene, self.camera)

    @cached_property
    def point_values(self) -> Float32Array:
        """(n, 10 + 2 c) what is interpolated: camera position, normal, own colour, heat value, light on either side."""
        scene = self.scene
        colors: FloatArray = np.ones((len(scene.points), 3))
        for surface, start in self._mesh_starts():
            if surface.mesh.colors is not None:
                colors[start : start + len(surface.mesh.points)] = surface.mesh.colors
        colors = colors if self.paint is None else self.paint
        heat = np.zeros(len(scene.points)) if self.heatmap is None else self.heatmap.values
        position = self.camera.to_camera(scene.points)
        turned = scene.normals @ self.camera.axes.T
        sides = [self.studio.carried(scene.sky, each, self.camera.axes) for each in (scene.normals, -scene.normals)]
        return np.column_stack([position, turned, colors, heat, *sides]).astype(np.float32)

    @cached_property
    def shadow(self) -> DepthMap | None:
        """The key light's view."""
        if self.studio.key is None or not len(self.scene.occluders):
            return None
        towards = self.studio.key.astype(np.float64) @ self.camera.axes
        return depth_map(self.scene.points, self.scene.occluders, towards, SHADOW_RESOLUTION)

    def prepare(self, ids: IntArray) -> None:
        """Compute what all samples share, several things at once, before samples in triangles `ids` are shaded."""
        textures = self.materials.textures(np.unique(self.scene.surface[ids]))
        levels = [partial(self.scene.textures.levels, texture) for texture in textures]
        calls: list[Callable[[], object]] = [lambda: self.point_values, lambda: self.shadow, *levels]
        mapped(lambda call: call(), calls)

    def _mesh_starts(self) -> list[tuple[Surface, int]]:
        surface, at = np.unique(self.scene.surface, return_index=True)
        return [(self.scene.surfaces[s], int(self.scene.first_point[t])) for s, t in zip(surface, at, strict=True)]

    def shade(self, ids: IntArray, x: FloatArray, y: FloatArray, *, grainy: bool = False) -> Shaded:
        """What leaves screen positions (m,) inside triangles `ids` (m,).

        :param grainy: soft shadows may have the grain of single pixels, which the caller takes out
        """
        parts = [slice(start, start + CHUNK) for start in range(0, len(ids), CHUNK)] or [slice(0, 0)]
        return joined(mapped(lambda part: self._shade(ids[part], x[part], y[part], grainy), parts))

    def opacity(self, ids: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """(m,) opacity at screen positions (m,) inside triangles `ids` (m,)."""
        opacity = np.empty(len(ids), np.float32)
        for start in range(0, len(ids), CHUNK):
            part = slice(start, start + CHUNK)
            weights = barycentrics(self.homogeneous, self.scene.triangles, ids[part], x[part], y[part])
            opacity[part] = self.materials.opacity(ids[part], weights.astype(np.float32))
        return opacity

    def _shade(self, ids: IntArray, x: FloatArray, y: FloatArray, grainy: bool) -> Shaded:
        weights = barycentrics(self.homogeneous, self.scene.triangles, ids, x, y).astype(np.float32)
        corners = self.scene.triangles[ids].T
        values = interpolated([self.point_values[corner] for corner in corners], weights)
        front = self.front[ids]
        normals = _unit(values[:, 3:6])
        surfaces = self.materials.at(ids, weights, normals, values[:, 6:9])
        if self.heatmap is not None:
            surfaces.base[:] = self.heatmap.colors(values[:, 9])
        elif self.paint is not None:
            surfaces.base[:] = values[:, 6:9]
        samples = self._samples(surfaces, values, front, ids)
        lit = self.studio.light(samples)
        for highlights in (lit.highlights, lit.key_highlights):
            highlights *= surfaces.gloss[:, None]
        lit.highlights[:] += surfaces.emission
        return Shaded(
            base=surfaces.base * (1 - surfaces.metallic[:, None]),
            lit=lit,
            scattered=np.zeros_like(lit.diffuse),
            key_light=_through(
                self._key_light(values[:, :3], samples.normals, _turns(x, y) if grainy else None), surfaces.through
            ),
            opacity=surfaces.opacity,
            presence=surfaces.presence,
            depth=-values[:, 2],
        )

    def _samples(self, surfaces: Surfaces, values: FloatArray, front: BoolArray, ids: IntArray) -> Samples:
        normals = surfaces.normals * np.where(front, 1, -1).astype(np.float32)[:, None]
        inside = np.where(front | self.scene.double_sided[ids], 1.0, INSIDE).astype(np.float32)
        return Samples(
            normals=normals,
            towards_eye=_unit(-values[:, :3]),
            up=self.camera.axes[:, 1].astype(np.float32),
            base=surfaces.base,
            roughness=surfaces.roughness,
            carried=_through(self._carried(values, front, ids).T, surfaces.through).T * surfaces.occlusion[:, None],
            mirror=surfaces.mirror,
            coat=surfaces.coat,
            coat_roughness=surfaces.coat_roughness,
            inside=inside,
        )

    def _carried(self, values: FloatArray, front: BoolArray, ids: IntArray) -> FloatArray:
        """(m, c) what the studio knows of the side that is seen; the inside of a single-sided mesh lies open."""
        ahead, behind = np.split(values[:, 10:], 2, axis=1)
        behind = np.where(self.scene.double_sided[ids][:, None], behind, np.float32(1))
        return np.where(front[:, None], ahead, behind)

    def _key_light(self, position: FloatArray, normals: FloatArray, turns: FloatArray | None) -> FloatArray:
        """(m,) share of the key light that arrives at camera positions (m, 3); `turns` as in `DepthMap.softly_lit`."""
        arriving = np.ones(len(position), np.float32)
        if self.shadow is None or self.studio.key is None:
            return arriving
        facing = np.flatnonzero(normals @ self.studio.key > -0.35)
        world = position[facing] @ self.camera.axes + self.camera.eye
        turned = normals[facing] @ self.camera.axes
        if turns is None:
            arriving[facing] = self.shadow.lit(world, turned, radius=2)
        else:
            arriving[facing] = self.shadow.softly_lit(world, turned, self.studio.spread, turns[facing])
        return arriving


def _through(light: FloatArray, share: FloatArray) -> FloatArray:
    """Shares of light (..., m) of which a share (m,) arrives in any case."""
    return light + share * (1 - light)


def _turns(x: FloatArray, y: FloatArray) -> FloatArray:
    """(m,) radians that differ between neighbouring pixels."""
    (across, down), scale = _PATTERN
    return np.asarray(2 * np.pi * (scale * ((across * np.floor(x) + down * np.floor(y)) % 1.0) % 1.0))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.sqrt(np.maximum(np.einsum("mc,mc->m", vectors, vectors), 1e-24))[:, None])
