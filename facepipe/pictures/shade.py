"""What a sample of the scene shows: its material with textures filtered for distance, heat map or paint, and light."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.rasterise import edge_planes, shares
from facepipe.geometry.vectors import cross_columns, dot_columns
from facepipe.parts import Material, Texture, TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import EVEN, PORTRAIT, Lit, PhotoLights, Portrait, Samples, Studio
from facepipe.pictures.occlusion import SHADOW_RESOLUTION, DepthMap, Sky, depth_map
from facepipe.pictures.overlay import HeatMap
from facepipe.pictures.scene import Places, Scene

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
_Look = Callable[..., tuple[Float32Array, Float32Array] | None]
_Folds = tuple[Float32Array, Float32Array] | None
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
        # by columns (c, m) that are handed on as rows: numpy takes five times as long over rows of three
        kind = self._scene.surface.take(ids)
        table = self._table.take(kind, axis=1)
        base, emission, (metallic, roughness, _, occlusion, coat, coat_roughness) = table[:3], table[3:6], table[6:12]
        opacity = self.opacity(ids, weights) if opacity is None else opacity
        if self._colored.any():
            base *= np.where(self._colored.take(kind), colors.T, np.float32(1))
        presence = np.maximum(opacity, 1 - roughness / _MATT)
        gloss, through = np.ones(len(ids), np.float32), np.zeros(len(ids), np.float32)
        turned = np.array(normals.T, order="C")
        fields = {
            "diffuse_color": base,
            "emissive_color": emission,
            "metallic": metallic[None],
            "roughness": roughness[None],
            "occlusion": occlusion[None],
            "clearcoat": coat[None],
            "clearcoat_roughness": coat_roughness[None],
        }
        for number in np.flatnonzero(np.bincount(kind)).tolist():
            material = self._each[number]
            if _inputs(material):
                at = np.flatnonzero(kind == number)
                look = self._look(ids.take(at), weights.T.take(at, axis=1))
                for name, target in fields.items():
                    source = getattr(material, name)
                    read = look(source) if isinstance(source, TextureInput) else None
                    if read is not None:
                        for row, values in zip(target, read[0], strict=True):
                            row[at] = np.clip(values, 0.0, 1.0)
                if isinstance(material.opacity, TextureInput):
                    matt, own = np.minimum(roughness[at] / _MATT, 1), opacity[at]
                    presence[at] = np.maximum(own, (1 - matt) * np.minimum(own / _CUT, 1))
                    gloss[at] = 1 - (1 - _STRANDS) * matt
                    through[at] = _THROUGH * matt
                folds = self._folds(material, look)
                if folds is not None:
                    base[:, at] *= folds[0]
                if material.normal is not None:
                    bent = self._bent(material.normal, turned.take(at, axis=1), ids.take(at), look, folds)
                    if bent is not None:
                        turned[:, at], length = bent
                        # Toksvig 2005: averaged normals are shorter, by as much as they vary.
                        roughness[at] = np.minimum((roughness[at] ** 4 + (1 - length) / length) ** 0.25, 1.0)
        mirror = table[12] + (base - table[12]) * metallic
        return Surfaces(
            base=base.T,
            emission=emission.T,
            metallic=metallic,
            roughness=roughness,
            opacity=opacity,
            presence=presence,
            gloss=gloss,
            through=through,
            occlusion=occlusion,
            coat=coat,
            coat_roughness=coat_roughness,
            mirror=mirror.T,
            normals=turned.T,
        )

    def opacity(self, ids: IntArray, weights: Float32Array) -> Float32Array:
        """(m,) opacity alone."""
        kind = self._scene.surface.take(ids)
        opacity: Float32Array = self._table[8].take(kind)
        for number in np.flatnonzero(np.bincount(kind)).tolist():
            material = self._each[number]
            if isinstance(material.opacity, TextureInput):
                at = np.flatnonzero(kind == number)
                look = self._look(ids.take(at), weights.T.take(at, axis=1))
                read = look(material.opacity, whole=material.opacity_threshold > 0)
                if read is not None:
                    found: FloatArray = read[0][0]
                    if material.opacity_threshold > 0:  # cut with an edge of a pixel at most, and of half a texel
                        found = np.asarray((found - material.opacity_threshold) / np.clip(read[1], 0.02, 0.5) + 0.5)
                    opacity[at] = np.clip(found, 0.0, 1.0)
        return opacity

    def _look(self, ids: IntArray, weights: Float32Array) -> _Look:
        """What reads textures at barycentrics (3, m) in triangles `ids` (m,) of one surface.

        It gives values (c, m), and how many texels a pixel spans (m,); None where the mesh lacks the UV set. With
        `whole` these are all texels in a pixel, as many as it spans its longer way; else as on average of both ways.
        """
        places: dict[tuple[str, bool], Places | None] = {}

        def look(
            source: TextureInput, *, color: bool = True, whole: bool = False
        ) -> tuple[Float32Array, Float32Array] | None:
            key = (source.uv_set, whole)
            if key not in places:
                places[key] = self._layouts[source.uv_set].places(ids, weights, whole=whole)
            at = places[key]
            return None if at is None else self._scene.textures.sample(source, at, color=color)

        return look

    def _folds(self, material: Material, look: _Look) -> _Folds:
        """Factor of the colour (3, m), and x and y (2, m) to add to the normal map's; None: nothing is wrinkled."""
        if material.wrinkles is None:
            return None
        reads = [(region.strength(self._weights), look(region.mask)) for region in material.wrinkles.regions]
        tint, normal = look(material.wrinkles.tint, color=False), look(material.wrinkles.normal, color=False)
        if tint is None or normal is None:
            return None
        strengths = (np.float32(strength) * mask[0] for strength, mask in reads if mask is not None)
        share = np.minimum(sum(strengths, np.zeros((1, tint[0].shape[1]), np.float32)), 1)
        return 1 + share * (tint[0] - 1), share * normal[0][:2]

    def _bent(
        self, source: TextureInput, outward: Float32Array, ids: IntArray, look: _Look, folds: _Folds
    ) -> tuple[Float32Array, Float32Array] | None:
        """Normals (3, m) turned by a normal map, and the lengths (m,) of what a pixel averages in it.

        :param folds: as `_folds` gives them
        """
        if source.scale[:2] == (1.0, 1.0):  # files that don't author scale and bias mean 2 and -1
            source = replace(source, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))
        read = look(source, color=False)
        if read is None:
            return None
        texel, layout = read[0], self._layouts[source.uv_set]
        length = np.clip(np.sqrt(dot_columns(texel, texel)), 0.5, 1.0)
        if folds is not None:
            texel[:2] += folds[1]
        bent = layout.along.take(ids, axis=1) * texel[0] + layout.across.take(ids, axis=1) * texel[1]
        bent += outward * (np.maximum(texel[2], 0.05) - dot_columns(bent, outward))
        return _unit_columns(bent), length

    @cached_property
    def _table(self) -> Float32Array:
        """(13, surfaces): base and emitted colour, `_NUMBERS`, mirror; where they are constant."""
        rows = []
        for material, colored in zip(self._each, self._colored, strict=True):
            base = (1.0, 1.0, 1.0) if colored else _constant(material.diffuse_color, CLAY)
            emitted = _constant(material.emissive_color, (0.0, 0.0, 0.0))
            numbers = [_constant(getattr(material, name), default) for name, default in _NUMBERS.items()]
            rows.append((*base, *emitted, *numbers, ((material.ior - 1) / (material.ior + 1)) ** 2))
        return np.ascontiguousarray(np.array(rows, np.float32).reshape(-1, 13).T)

    @cached_property
    def _colored(self) -> BoolArray:
        """(surfaces,) whether the points' own colours count: they stand for a constant colour, not for a texture."""
        own = (surface.mesh.colors is not None for surface in self._scene.surfaces)
        textured = (isinstance(material.diffuse_color, TextureInput) for material in self._each)
        return np.array([a and not b for a, b in zip(own, textured, strict=True)], dtype=bool)


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """How one UV set lies on the triangles."""

    corners: (
        Float32Array  # (6, t) u and v of the first corner, of the second, of the third, NaN where the mesh lacks it
    )
    footprint: Float32Array  # (t,) length in UV space that a pixel spans
    longest: Float32Array  # (t,) the same the way that it spans most, and `_STRETCH` of that at most
    along: Float32Array  # (3, t) unit tangents in camera axes: the way that u grows
    across: Float32Array  # (3, t) and v

    def places(self, ids: IntArray, weights: Float32Array, *, whole: bool) -> Places | None:
        """Where barycentrics (3, m) in triangles `ids` (m,) of one surface lie; None where it lacks the UV set."""
        if len(ids) == 0 or np.isnan(self.corners[0, ids[0]]):
            return None
        uv = []
        for axis in range(2):
            first, second, third = (self.corners[row].take(ids) for row in (axis, axis + 2, axis + 4))
            uv.append(first * weights[0] + second * weights[1] + third * weights[2])
        return Places(uv, (self.longest if whole else self.footprint).take(ids))


def _layout(scene: Scene, camera: Camera, uv_set: str) -> _Layout:
    # a damaged file's UVs can be beyond what float32 multiplies; at a million it holds no part of a texture any more
    corners = np.clip(scene.uv_corners(uv_set), -_FARTHEST_UV, _FARTHEST_UV)
    corners = np.ascontiguousarray(corners.reshape(-1, 6).T)
    (u1, v1), (u2, v2) = corners[2:4] - corners[:2], corners[4:] - corners[:2]
    area = u1 * v2 - u2 * v1
    points = np.ascontiguousarray(camera.to_camera(scene.points).T, np.float32)
    first, second, third = (points.take(each, axis=1) for each in scene.triangles.T)
    depth = np.maximum(-first[2], 1e-6)
    p1, p2 = second - first, third - first
    facing = np.abs(dot_columns(cross_columns(p1, p2), first)) / depth
    pixels = np.maximum(facing * (camera.focal / depth) ** 2, 1e-6)
    footprint = np.sqrt(np.abs(area) / pixels)
    (x1, y1, _), (x2, y2, _) = p1, p2
    right, down = np.hypot(u1 * y2 - u2 * y1, v1 * y2 - v2 * y1), np.hypot(u2 * x1 - u1 * x2, v2 * x1 - v1 * x2)
    longest = np.maximum(right, down) / np.maximum(np.abs(x1 * y2 - x2 * y1), 1e-12) * depth / camera.focal
    sign = np.where(area < 0, np.float32(-1), np.float32(1))
    return _Layout(
        corners=corners,
        footprint=footprint,
        longest=np.clip(longest, footprint, _STRETCH * footprint),
        along=_unit_columns((p1 * v2 - p2 * v1) * sign),
        across=_unit_columns((p2 * u1 - p1 * u2) * sign),
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


def _unit_columns(vectors: FloatArray) -> Float32Array:
    """(3, m) of length 1."""
    return np.asarray(vectors / np.sqrt(np.maximum(dot_columns(vectors, vectors), 1e-24)), np.float32)


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
        """(3, t) unit vectors across the triangles."""
        return _unit_columns(self.scene.facets.T)

    @cached_property
    def planes(self) -> FloatArray:
        """(9, t) `edge_planes` of the camera."""
        return edge_planes(self.homogeneous, self.scene.triangles)

    @cached_property
    def materials(self) -> Materials:
        """The materials of the scene, read where samples lie."""
        return Materials(self.scene, self.camera, self.weights)

    @cached_property
    def used(self) -> IntArray:
        """Points whose values are interpolated; `prepare` knows which of all."""
        return np.arange(len(self.scene.points))

    @cached_property
    def sky(self) -> Sky:
        """What the points that are used see of the sky."""
        return self.scene.sky_of(self.used)

    @cached_property
    def point_values(self) -> Float32Array:
        """(n, 6 + c + k) what is interpolated: camera position, normal, light on the side of the normal, `look_values`.

        0 at points that are not used, like `behind`: in a picture of a head three of four are hidden.
        """
        normals = self.scene.normals[self.used]
        position, turned = self.camera.to_camera(self.scene.points[self.used]), normals @ self.camera.axes.T
        ahead = self.studio.carried(self.sky, normals, self.camera.axes)
        return self._of_all([position, turned, ahead, self.look_values[self.used]])

    @cached_property
    def behind(self) -> Float32Array:
        """(n, c) light on the other side."""
        return self._of_all([self.studio.carried(self.sky, -self.scene.normals[self.used], self.camera.axes)])

    def _of_all(self, columns: Sequence[FloatArray]) -> Float32Array:
        values = np.zeros((len(self.scene.points), sum(one.shape[1] for one in columns)), np.float32)
        values[self.used] = np.column_stack(columns)
        return values

    @cached_property
    def look_values(self) -> FloatArray:
        """(n, 0), or (n, 1) heat values, or (n, 3) colours of points: paint, or their own."""
        scene, meshes = self.scene, [surface.mesh for surface in self.scene.surfaces]
        if self.heatmap is not None:
            return self.heatmap.values[:, None]
        if self.paint is not None:
            return self.paint
        if all(mesh.colors is None for mesh in meshes):
            return np.zeros((len(scene.points), 0))
        colors: FloatArray = np.ones((len(scene.points), 3))
        numbers, at = np.unique(scene.surface, return_index=True)
        for number, triangle in zip(numbers, at, strict=True):
            own, start = meshes[number].colors, int(scene.first_point[triangle])
            if own is not None:
                colors[start : start + len(own)] = own
        return colors

    @cached_property
    def shadow(self) -> DepthMap | None:
        """The key light's view."""
        if self.studio.key is None or not len(self.scene.occluders):
            return None
        towards = self.studio.key.astype(np.float64) @ self.camera.axes
        return depth_map(self.scene.points, self.scene.occluders, towards, SHADOW_RESOLUTION)

    def prepare(self, ids: IntArray) -> None:
        """Compute what all samples share, several things at once, before samples in triangles `ids` are shaded."""
        used = np.zeros(len(self.scene.points), bool)
        used[self.scene.triangles.take(ids, axis=0)] = True
        self.__dict__["used"] = np.flatnonzero(used)
        textures = self.materials.textures(np.flatnonzero(np.bincount(self.scene.surface.take(ids))))
        levels = [partial(self.scene.textures.levels, texture) for texture in textures]
        calls: list[Callable[[], object]] = [lambda: self.shadow, *levels]
        mapped(lambda call: call(), calls)
        _ = self.point_values  # several at once in themselves

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
            weights = shares(self.planes, ids[part], x[part], y[part]).astype(np.float32)
            opacity[part] = self.materials.opacity(ids[part], weights.T)
        return opacity

    def _shade(self, ids: IntArray, x: FloatArray, y: FloatArray, grainy: bool, opacity: Float32Array | None) -> Shaded:
        weights = shares(self.planes, ids, x, y).astype(np.float32)
        corners = self.scene.triangles.take(ids, axis=0).T
        values = _between(self.point_values, corners, weights)
        front, sided = self.front.take(ids), self.scene.double_sided.take(ids)
        position, normals = values[:3], _unit_columns(values[3:6])
        ahead, own = np.split(values[6:], [values.shape[0] - 6 - self.look_values.shape[1]])
        colored = self.heatmap is None and len(own) == 3
        white = np.broadcast_to(np.float32(1), (len(ids), 3))
        surfaces = self.materials.at(ids, weights.T, normals.T, own.T if colored else white, opacity)
        if self.heatmap is not None:
            surfaces.base[:] = self.heatmap.colors(own[0])
        elif self.paint is not None:
            surfaces.base[:] = own.T
        normals = surfaces.normals.T * np.where(front, 1, -1).astype(np.float32)
        inside = np.where(front | sided, 1.0, INSIDE).astype(np.float32)
        # (c, m) what the studio knows of the side that is seen; the inside of a single-sided mesh lies open
        at = np.flatnonzero(~front)
        ahead[:, at] = 1.0
        at = at[sided[at]]
        ahead[:, at] = _between(self.behind, corners[:, at], weights[:, at])
        samples = Samples(
            normals=normals.T,
            towards_eye=_unit_columns(-position).T,
            up=self.camera.axes[:, 1].astype(np.float32),
            base=surfaces.base,
            roughness=surfaces.roughness,
            carried=(_through(ahead, surfaces.through) * surfaces.occlusion).T,
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
            key_light=_through(self._key_light(position.T, samples.normals, turns), surfaces.through),
            opacity=surfaces.opacity,
            presence=surfaces.presence,
            depth=-position[2],
        )

    def _key_light(self, position: FloatArray, normals: FloatArray, turns: FloatArray | None) -> FloatArray:
        """(m,) share of the key light that arrives at camera positions (m, 3); `turns` as in `DepthMap.softly_lit`."""
        arriving = np.ones(len(position), np.float32)
        if self.shadow is None or self.studio.key is None:
            return arriving
        facing = np.flatnonzero(normals @ self.studio.key > -0.35)
        world = position.T.take(facing, axis=1).T @ self.camera.axes + self.camera.eye
        turned = normals.T.take(facing, axis=1).T @ self.camera.axes
        if turns is None:
            arriving[facing] = self.shadow.lit(world, turned, radius=2)
        else:
            arriving[facing] = self.shadow.softly_lit(world, turned, self.studio.spread, turns[facing])
        return arriving


def _through(light: FloatArray, share: FloatArray) -> FloatArray:
    """Shares of light (..., m) of which a share (m,) arrives in any case."""
    return light + share * (1 - light)


def _between(values: Float32Array, corners: IntArray, weights: Float32Array) -> Float32Array:
    """(c, m) values (n, c) of points at barycentrics (3, m) between corners (3, m)."""
    rows = values.take(corners[0], axis=0) * weights[0, :, None]
    for corner, share in zip(corners[1:], weights[1:], strict=True):
        rows += values.take(corner, axis=0) * share[:, None]
    return np.ascontiguousarray(rows.T)
