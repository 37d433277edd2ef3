"""What colour a sample of the scene has: materials, heat maps and light put together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.heatmap import HeatMap
from facepipe.pictures.lighting import EVEN, PORTRAIT, Samples, Studio, lit
from facepipe.pictures.occlusion import SHADOW_RESOLUTION, DepthMap, depth_map
from facepipe.pictures.rasterise import barycentrics
from facepipe.pictures.scene import Scene, Surface
from facepipe.pictures.textures import TextureCache

CLAY = (0.50, 0.40, 0.345)  # linear; a face without a material
INSIDE = 0.28  # how much light the inner side of a single-sided mesh gets
CHUNK = 100_000  # samples shaded at once


@dataclass(frozen=True)
class Shader:
    """Shades samples of one scene seen by one camera."""

    scene: Scene
    camera: Camera
    textures: TextureCache
    heatmap: HeatMap | None = None
    paint: FloatArray | None = None  # (n, 3) linear colours per point instead of the materials'
    lights: Studio | None = None  # instead of those of `studio`

    @cached_property
    def studio(self) -> Studio:
        """The lights given; else even light where colours must be read, portrait light otherwise."""
        if self.lights is not None:
            return self.lights
        return PORTRAIT if self.heatmap is None and self.paint is None else EVEN

    @cached_property
    def homogeneous(self) -> FloatArray:
        """(n, 4) screen points of the camera."""
        return self.camera.project(self.scene.points)

    @cached_property
    def front(self) -> npt.NDArray[np.bool_]:
        """(t,) triangles that turn their outside to the camera."""
        corners = self.scene.points[self.scene.triangles]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(np.einsum("tc,tc->t", outward, self.camera.eye - corners[:, 0]) > 0)

    @cached_property
    def point_values(self) -> npt.NDArray[np.float32]:
        """(n, 11) what is interpolated: camera position, normal, sky seen, own colour, heat value."""
        scene = self.scene
        colors: FloatArray = np.ones((len(scene.points), 3))
        for surface, start in self._mesh_starts():
            if surface.mesh.colors is not None:
                colors[start : start + len(surface.mesh.points)] = surface.mesh.colors
        colors = colors if self.paint is None else self.paint
        heat = np.zeros(len(scene.points)) if self.heatmap is None else self.heatmap.values
        position = self.camera.to_camera(scene.points)
        turned = scene.normals @ self.camera.axes.T
        return np.column_stack([position, turned, scene.sky, colors, heat]).astype(np.float32)

    @cached_property
    def shadow(self) -> DepthMap | None:
        """The key light's view."""
        if not self.studio.shadows or not self.studio.lights or not len(self.scene.occluders):
            return None
        towards = self.studio.lights[0].unit.astype(np.float64) @ self.camera.axes
        return depth_map(self.scene.points, self.scene.occluders, towards, SHADOW_RESOLUTION)

    def _mesh_starts(self) -> list[tuple[Surface, int]]:
        surface, at = np.unique(self.scene.surface, return_index=True)
        return [(self.scene.surfaces[s], int(self.scene.first_point[t])) for s, t in zip(surface, at, strict=True)]

    def shade(self, ids: IntArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Premultiplied linear colours (m, 3) and opacities (m,) at screen positions inside triangles `ids` (m,)."""
        color, opacity = np.empty((len(ids), 3), np.float32), np.empty(len(ids), np.float32)
        for start in range(0, len(ids), CHUNK):
            part = slice(start, start + CHUNK)
            color[part], opacity[part] = self._shade(ids[part], x[part], y[part])
        return color, opacity

    def _shade(self, ids: IntArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        weights = barycentrics(self.homogeneous, self.scene.triangles, ids, x, y).astype(np.float32)
        corners = self.point_values[self.scene.triangles[ids]]
        values = np.einsum("mk,mkc->mc", weights, corners)
        front, two_sided = self.front[ids], self.scene.double_sided[ids]
        flip = np.where(front, 1, -1).astype(np.float32)[:, None]
        normals = _unit(values[:, 3:6] * flip)
        inside = np.where(front | two_sided, 1.0, INSIDE).astype(np.float32)
        base, roughness, opacity = self._surface(ids, weights, values)
        sky = np.where(front, values[:, 6], 1.0) * inside
        samples = Samples(
            normals=normals,
            towards_eye=_unit(-values[:, :3]),
            up=self.camera.axes[:, 1].astype(np.float32),
            base=base,
            roughness=roughness,
            opacity=opacity,
            ambient=sky.astype(np.float32),
            key_light=self._key_light(values[:, :3], normals) * inside,
        )
        color = lit(samples, self.studio)
        color[opacity <= 0] = 0  # cut away by an alpha test or a mask: nothing there to glint
        return color, opacity

    def _key_light(self, position: FloatArray, normals: FloatArray) -> FloatArray:
        """(m,) share of the key light that arrives at camera positions (m, 3)."""
        if self.shadow is None:
            return np.ones(len(position), np.float32)
        arriving = np.ones(len(position), np.float32)
        facing = np.flatnonzero(normals @ self.studio.lights[0].unit > -0.35)
        world = position[facing] @ self.camera.axes + self.camera.eye
        arriving[facing] = self.shadow.lit(world, normals[facing] @ self.camera.axes, radius=2)
        return arriving

    def _surface(self, ids: IntArray, weights: FloatArray, values: FloatArray) -> tuple[FloatArray, ...]:
        """Base colour (m, 3), roughness (m,) and opacity (m,)."""
        table = self._table
        kind = self.scene.surface[ids]
        base = table[kind, :3] * np.where(table[kind, 5:6] > 0, values[:, 7:10], 1.0)
        roughness, opacity = table[kind, 3].copy(), table[kind, 4].copy()
        for number in np.unique(kind):
            surface = self.scene.surfaces[number]
            at = np.flatnonzero(kind == number)
            for target, source in self._texture_inputs(surface, base, roughness, opacity):
                uv = self.scene.uv(surface, source.uv_set, ids[at], weights[at])
                if uv is not None:
                    target[at] = np.clip(self.textures.sample(source, uv), 0.0, 1.0)
            threshold = surface.material.opacity_threshold if surface.material else 0.0
            if threshold > 0:
                opacity[at] = opacity[at] >= threshold
        if self.heatmap is not None:
            base = self.heatmap.colors(values[:, 10]).astype(np.float32)
        elif self.paint is not None:
            base = values[:, 7:10]
        return base.astype(np.float32), roughness, opacity

    @staticmethod
    def _texture_inputs(
        surface: Surface, base: FloatArray, roughness: FloatArray, opacity: FloatArray
    ) -> list[tuple[FloatArray, TextureInput]]:
        material = surface.material
        if material is None:
            return []
        pairs = [
            (base, material.diffuse_color),
            (roughness[:, None], material.roughness),
            (opacity[:, None], material.opacity),
        ]
        return [(target, source) for target, source in pairs if isinstance(source, TextureInput)]

    @cached_property
    def _table(self) -> npt.NDArray[np.float32]:
        """(surfaces, 6): base colour, roughness, opacity, whether the points' own colours count."""
        rows = []
        for surface in self.scene.surfaces:
            material, own = surface.material, surface.mesh.colors is not None
            color = material.diffuse_color if material else CLAY
            roughness = _constant(material.roughness if material else 0.5, 0.5)
            opacity = _constant(material.opacity if material else 1.0, 1.0)
            if isinstance(color, TextureInput):
                color, own = CLAY, False
            rows.append((*((1.0, 1.0, 1.0) if own else color), roughness, opacity, own))
        return np.array(rows, np.float32).reshape(-1, 6)


def _constant(value: float | TextureInput, otherwise: float) -> float:
    return otherwise if isinstance(value, TextureInput) else value


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.sqrt(np.maximum(np.einsum("mc,mc->m", vectors, vectors), 1e-24))[:, None])
