"""What a sample of the scene shows: its material with textures filtered for distance, heat map or paint, and light."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.rasterise import barycentrics, interpolated
from facepipe.parts import Material, Texture, TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import EVEN, PORTRAIT, Lit, PhotoLights, Portrait, Samples, Studio
from facepipe.pictures.occlusion import SHADOW_RESOLUTION, DepthMap, depth_map
from facepipe.pictures.overlay import HeatMap
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
D = TypeVar("D")
INSIDE = 0.28  # how much light the inner side of a single-sided mesh gets
CHUNK = 20_000  # samples shaded at once
_PATTERN = np.array([0.06711056, 0.00583715]), 52.9829189  # interleaved gradient noise (Jimenez 2014)


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

    def __init__(self, scene: Scene, camera: Camera, weights: Mapping[str, float]) -> None:
        """:param weights: of shapes, which wrinkle the skin"""
        self._scene, self._camera = scene, camera
        self._each = [_wrinkled(surface.material or _PLAIN, weights) for surface in scene.surfaces]
        self._weights = weights
        uv_sets = {one.uv_set for material in self._each for one in _inputs(material)}
        self._layouts = {name: _layout(scene, camera, name) for name in uv_sets}

    def textures(self, surfaces: IntArray) -> list[Texture]:
        """What some surfaces read of textures, each once; nothing by UV sets that their meshes lack."""
        textures: dict[Texture, None] = {}
        for number in surfaces:
            names = {uv_set.name for uv_set in self._scene.surfaces[number].mesh.uv_sets}
            textures |= {one.texture: None for one in _inputs(self._each[number]) if one.uv_set in names}
        return list(textures)

    def at(
        self,
        ids: IntArray,
        weights: Float32Array,
        normals: Float32Array,
        colors: Float32Array,
        opacity: Float32Array | None = None,
    ) -> Surfaces:
        """The surface at barycentrics (m, 3) in triangles `ids` (m,).

        :param normals: (m, 3) unit, camera axes, to the outside
        :param colors: (m, 3) the points' own
        :param opacity: (m,) of `opacity`, if that is known
        """
        kind = self._scene.surface[ids]
        table = self._table.take(kind, axis=0)
        opacity = self.opacity(ids, weights) if opacity is None else opacity
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
                own_ids, own_weights = ids.take(at), weights.take(at, axis=0)
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
                    read = self._read(source, own_ids, own_weights) if isinstance(source, TextureInput) else None
                    if read is not None:
                        target[at] = np.clip(read[0], 0.0, 1.0)
                if isinstance(material.opacity, TextureInput):
                    matt = np.minimum(surfaces.roughness[at] / _MATT, 1)
                    surfaces.presence[at] = np.maximum(
                        surfaces.opacity[at], (1 - matt) * np.minimum(surfaces.opacity[at] / _CUT, 1)
                    )
                    surfaces.gloss[at] = 1 - (1 - _STRANDS) * matt
                    surfaces.through[at] = _THROUGH * matt
                folds = self._folds(material, own_ids, own_weights)
                if folds is not None:
                    surfaces.base[at] *= folds[0]
                if material.normal is not None:
                    self._bend(material.normal, surfaces, at, own_ids, own_weights, None if folds is None else folds[1])
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
                whole = material.opacity_threshold > 0
                read = self._read(material.opacity, ids.take(at), weights.take(at, axis=0), whole=whole)
                if read is not None:
                    found: FloatArray = read[0][:, 0]
                    if material.opacity_threshold > 0:  # cut with an edge of a pixel at most, and of half a texel
                        found = np.asarray((found - material.opacity_threshold) / np.clip(read[1], 0.02, 0.5) + 0.5)
                    opacity[at] = np.clip(found, 0.0, 1.0)
        return opacity

    def _read(
        self, source: TextureInput, ids: IntArray, weights: Float32Array, *, color: bool = True, whole: bool = False
    ) -> tuple[Float32Array, Float32Array] | None:
        """Values (m, c), and how many texels a pixel spans (m,); None where the mesh lacks the UV set.

        :param whole: of all texels in a pixel, as many as it spans its longer way; else as on average of both ways
        """
        layout = self._layouts[source.uv_set]
        if len(ids) == 0 or np.isnan(layout.corners[ids[0], 0, 0]):
            return None
        corners = layout.corners.take(ids, axis=0)
        uv = interpolated((corners[:, 0], corners[:, 1], corners[:, 2]), weights)
        footprint = layout.longest if whole else layout.footprint
        return self._scene.textures.sample(source, uv, footprint.take(ids), color=color)

    def _folds(
        self, material: Material, ids: IntArray, weights: Float32Array
    ) -> tuple[Float32Array, Float32Array] | None:
        """Factor of the colour (m, 3), and x and y (m, 2) to add to the normal map's; None: nothing is wrinkled."""
        if material.wrinkles is None:
            return None
        reads = [
            (region.strength(self._weights), self._read(region.mask, ids, weights))
            for region in material.wrinkles.regions
        ]
        tint = self._read(material.wrinkles.tint, ids, weights, color=False)
        normal = self._read(material.wrinkles.normal, ids, weights, color=False)
        if tint is None or normal is None:
            return None
        strengths = (np.float32(strength) * mask[0] for strength, mask in reads if mask is not None)
        share = np.minimum(sum(strengths, np.zeros((len(ids), 1), np.float32)), 1)
        return 1 + share * (tint[0] - 1), share * normal[0][:, :2]

    def _bend(
        self,
        source: TextureInput,
        surfaces: Surfaces,
        at: IntArray,
        ids: IntArray,
        weights: Float32Array,
        folds: Float32Array | None,
    ) -> None:
        """Turn normals by a normal map; where a pixel spans many of its bumps, roughen the surface instead.

        :param folds: (m, 2) what is added to x and y
        """
        if source.scale[:2] == (1.0, 1.0):  # files that don't author scale and bias mean 2 and -1
            source = replace(source, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))
        read = self._read(source, ids, weights, color=False)
        if read is None:
            return
        texel, layout = read[0], self._layouts[source.uv_set]
        # Toksvig 2005: averaged normals are shorter, by as much as they vary.
        length = np.clip(np.sqrt(_dot(texel, texel)), 0.5, 1.0)
        surfaces.roughness[at] = np.minimum((surfaces.roughness[at] ** 4 + (1 - length) / length) ** 0.25, 1.0)
        if folds is not None:
            texel[:, :2] += folds
        outward = surfaces.normals.take(at, axis=0)
        bent = layout.along.take(ids, axis=0) * texel[:, :1] + layout.across.take(ids, axis=0) * texel[:, 1:2]
        bent += outward * (np.maximum(texel[:, 2], 0.05) - _dot(bent, outward))[:, None]
        surfaces.normals[at] = _unit(bent)

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


def _wrinkled(material: Material, weights: Mapping[str, float]) -> Material:
    """The material with those regions of wrinkles alone that shape weights draw, or none."""
    if material.wrinkles is None or material.normal is None:
        return replace(material, wrinkles=None)
    drawn = tuple(region for region in material.wrinkles.regions if region.strength(weights) > 0)
    return replace(material, wrinkles=replace(material.wrinkles, regions=drawn) if drawn else None)


def _inputs(material: Material) -> list[TextureInput]:
    """What a material reads from textures."""
    values = (getattr(material, name) for name in _TEXTURED)
    own = [value for value in values if isinstance(value, TextureInput)]
    return own if material.wrinkles is None else [*own, *material.wrinkles.inputs]


def _constant(value: T | TextureInput, otherwise: T) -> T:
    return otherwise if isinstance(value, TextureInput) else value


def _unit(vectors: FloatArray, least: float = 1e-24) -> Float32Array:
    """(m, 3) of length 1; with a square below the `least` they are shorter."""
    squares = np.maximum(_dot(vectors, vectors), least)
    return np.asarray(vectors / np.sqrt(squares)[:, None], np.float32)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) products of vectors (m, 3): numpy's own sums over three numbers take four times as long."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def joined(parts: Sequence[D]) -> D:
    """The rows of several of a kind, one after the other."""
    columns = {each.name: [getattr(part, each.name) for part in parts] for each in fields(_any(parts[0]))}
    values = {
        name: joined(those) if is_dataclass(those[0]) else np.concatenate(those) for name, those in columns.items()
    }
    return type(parts[0])(**values)


def chosen(whole: D, at: IntArray) -> D:
    """The rows numbered `at`."""
    columns = {each.name: getattr(whole, each.name) for each in fields(_any(whole))}
    return type(whole)(
        **{name: chosen(one, at) if is_dataclass(one) else one.take(at, axis=0) for name, one in columns.items()}
    )


def _any(value: object) -> Any:
    return value


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
    weights: Mapping[str, float] = field(default_factory=dict)  # of shapes, which wrinkle the skin

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
        return _unit(self.scene.facets)

    @cached_property
    def materials(self) -> Materials:
        """The materials of the scene, read where samples lie."""
        return Materials(self.scene, self.camera, self.weights)

    @cached_property
    def point_values(self) -> Float32Array:
        """(n, 10 + 2 c) what is interpolated: camera position, normal, own colour, heat value, light on either side."""
        scene = self.scene
        colors: FloatArray = np.ones((len(scene.points), 3))
        numbers, at = np.unique(self.scene.surface, return_index=True)
        for number, triangle in zip(numbers, at, strict=True):
            surface, start = self.scene.surfaces[number], int(self.scene.first_point[triangle])
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

    def shade(
        self,
        ids: IntArray,
        x: FloatArray,
        y: FloatArray,
        *,
        grainy: bool = False,
        opacity: Float32Array | None = None,
    ) -> Shaded:
        """What leaves screen positions (m,) inside triangles `ids` (m,).

        :param grainy: soft shadows may have the grain of single pixels, which the caller takes out
        :param opacity: (m,) of `opacity`, if that is known
        """
        parts = [slice(start, start + CHUNK) for start in range(0, len(ids), CHUNK)] or [slice(0, 0)]
        known = (None for _ in parts) if opacity is None else (opacity[part] for part in parts)
        calls = zip(parts, known, strict=True)
        return joined(mapped(lambda call: self._shade(ids[call[0]], x[call[0]], y[call[0]], grainy, call[1]), calls))

    def opacity(self, ids: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """(m,) opacity at screen positions (m,) inside triangles `ids` (m,)."""
        opacity = np.empty(len(ids), np.float32)
        for start in range(0, len(ids), CHUNK):
            part = slice(start, start + CHUNK)
            weights = barycentrics(self.homogeneous, self.scene.triangles, ids[part], x[part], y[part])
            opacity[part] = self.materials.opacity(ids[part], weights.astype(np.float32))
        return opacity

    def _shade(self, ids: IntArray, x: FloatArray, y: FloatArray, grainy: bool, opacity: Float32Array | None) -> Shaded:
        weights = barycentrics(self.homogeneous, self.scene.triangles, ids, x, y).astype(np.float32)
        corners = self.scene.triangles.take(ids, axis=0).T
        values = interpolated([self.point_values.take(corner, axis=0) for corner in corners], weights)
        front = self.front[ids]
        normals = _unit(values[:, 3:6])
        surfaces = self.materials.at(ids, weights, normals, values[:, 6:9], opacity)
        if self.heatmap is not None:
            surfaces.base[:] = self.heatmap.colors(values[:, 9])
        elif self.paint is not None:
            surfaces.base[:] = values[:, 6:9]
        normals = surfaces.normals * np.where(front, 1, -1).astype(np.float32)[:, None]
        inside = np.where(front | self.scene.double_sided[ids], 1.0, INSIDE).astype(np.float32)
        # (m, c) what the studio knows of the side that is seen; the inside of a single-sided mesh lies open
        ahead, behind = np.split(values[:, 10:], 2, axis=1)
        behind = np.where(self.scene.double_sided[ids][:, None], behind, np.float32(1))
        samples = Samples(
            normals=normals,
            towards_eye=_unit(-values[:, :3]),
            up=self.camera.axes[:, 1].astype(np.float32),
            base=surfaces.base,
            roughness=surfaces.roughness,
            carried=_through(np.where(front[:, None], ahead, behind).T, surfaces.through).T
            * surfaces.occlusion[:, None],
            mirror=surfaces.mirror,
            coat=surfaces.coat,
            coat_roughness=surfaces.coat_roughness,
            inside=inside,
        )
        lit = self.studio.light(samples)
        for highlights in (lit.highlights, lit.key_highlights):
            highlights *= surfaces.gloss[:, None]
        lit.highlights[:] += surfaces.emission
        (across, down), scale = _PATTERN  # radians that differ between neighbouring pixels
        pattern = scale * ((across * np.floor(x) + down * np.floor(y)) % 1.0) % 1.0
        turns = np.asarray(2 * np.pi * pattern) if grainy else None
        return Shaded(
            base=surfaces.base * (1 - surfaces.metallic[:, None]),
            lit=lit,
            scattered=np.zeros_like(lit.diffuse),
            key_light=_through(self._key_light(values[:, :3], samples.normals, turns), surfaces.through),
            opacity=surfaces.opacity,
            presence=surfaces.presence,
            depth=-values[:, 2],
        )

    def _key_light(self, position: FloatArray, normals: FloatArray, turns: FloatArray | None) -> FloatArray:
        """(m,) share of the key light that arrives at camera positions (m, 3); `turns` as in `DepthMap.softly_lit`."""
        arriving = np.ones(len(position), np.float32)
        if self.shadow is None or self.studio.key is None:
            return arriving
        facing = np.flatnonzero(normals @ self.studio.key > -0.35)
        world = position.take(facing, axis=0) @ self.camera.axes + self.camera.eye
        turned = normals.take(facing, axis=0) @ self.camera.axes
        if turns is None:
            arriving[facing] = self.shadow.lit(world, turned, radius=2)
        else:
            arriving[facing] = self.shadow.softly_lit(world, turned, self.studio.spread, turns[facing])
        return arriving


def _through(light: FloatArray, share: FloatArray) -> FloatArray:
    """Shares of light (..., m) of which a share (m,) arrives in any case."""
    return light + share * (1 - light)
