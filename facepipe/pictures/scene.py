"""All meshes of a face as one triangle soup, ready to draw, and lookups of their textures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import AnyArray, BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.images import decoding, open_image, pixels
from facepipe.geometry.colors import from_srgb
from facepipe.geometry.polygons import point_normals, triangulate
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Material, Mesh, Texture, TextureInput
from facepipe.pictures.camera import y_up
from facepipe.pictures.occlusion import SKY_RESOLUTION, Sky, SkyMaps

CHANNELS = {"rgb": slice(0, 3), "r": slice(0, 1), "g": slice(1, 2), "b": slice(2, 3), "a": slice(3, 4)}


_PLAIN = ("L", "LA", "RGB", "RGBA")  # modes whose channels are halved as those of RGBA are
_STEP = np.float32(1 / 255)
_SRGB: Float32Array = from_srgb(np.arange(256) / 255.0).astype(np.float32)
_DENSE = 0.4  # opacity from which a piece of a card hides the light like a solid one
_Looked = tuple[IntArray, list[ByteArray], Float32Array, Float32Array]  # samples, four texels of each, and between
WELD_COSINE = 0.5  # points at one place share a normal when theirs differ by less than 60 degrees


def decode(texture: Texture, largest: int) -> ByteArray:
    """(h, w, 4) pixels of a texture, top row first, halved until no side is above `largest`.

    :raises InputError: the bytes are not an image that can be read
    """
    return Levels(texture, largest)[0]


class Levels:
    """A decoded texture, and halved again and again, down to one pixel a side: arrays (h, w, 4), top row first."""

    def __init__(self, texture: Texture, largest: int) -> None:
        """As `decode`."""
        from PIL import Image

        where = f"texture {texture.name}"
        image = open_image(texture.image(), where)
        image.draft(None, (largest, largest))  # a JPEG is decoded at a half or less where that is enough
        factor = max(1, max(image.size) // max(largest, 1))
        if factor == 1 and image.mode in _PLAIN and "transparency" not in image.info:
            with decoding(where):
                image.load()
        else:
            image = Image.fromarray(pixels(image, "RGBA", where, factor))
        self._images = [image]
        while min(self._images[-1].size) > 1:
            self._images.append(self._images[-1].reduce(2))
        self.shapes = tuple((image.height, image.width) for image in self._images)
        self._arrays: dict[int, ByteArray] = {}

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, number: int) -> ByteArray:
        """The level, made an array when it is first read: of most textures nobody sees the first, half of their time.

        :raises IndexError: there is none
        """
        if number not in self._arrays:
            self._arrays[number] = np.asarray(self._images[number].convert("RGBA"))
        return self._arrays[number]


class TextureCache:
    """Decoded textures, whole and halved again and again, each decoded once."""

    def __init__(self, largest: int) -> None:
        """:param largest: pixels a side beyond which a texture holds more than the picture can show."""
        self.levels = lru_cache(maxsize=None)(lambda texture: Levels(texture, largest))

    def sample(self, source: TextureInput, places: Places, *, color: bool = True) -> tuple[Float32Array, Float32Array]:
        """Values (3, m) or (1, m) at places, ``texel[channels] * scale + bias``; texels that a pixel spans (m,).

        :param color: the texture holds sRGB colours where three channels are asked for, which become linear
        """
        levels, part = self.levels(source.texture), CHANNELS[source.channels]
        # UsdPreviewSurface's automatic colour space: 8-bit RGB is sRGB, single channels are data.
        linear = source.channels == "rgb" and color
        texels, parts = places.texels(source, levels)
        values = np.empty((part.stop - part.start, len(texels)), np.float32)
        for at, corners, right, down in parts:
            for row, channel in zip(values, range(4)[part], strict=True):
                bytes_of = (corner[:, channel] for corner in corners)
                four = [_SRGB.take(one) if linear else one.astype(np.float32) for one in bytes_of]
                row[at] = _mixed(four, right, down) * (1 if linear else _STEP)
        for row, channel in zip(values, range(4)[part], strict=True):
            if (source.scale[channel], source.bias[channel]) != (1.0, 0.0):
                row *= np.float32(source.scale[channel])
                row += np.float32(source.bias[channel])
        return values, texels


class Places:
    """Where samples lie in a UV set; what several textures need there is found once."""

    def __init__(self, uv: Sequence[FloatArray], footprint: FloatArray) -> None:
        """:param uv: u and v (m,)
        :param footprint: (m,) length in UV space that a pixel of the picture spans
        """
        self._uv, self._footprint = uv, footprint
        self._found: dict[object, Any] = {}

    def texels(self, source: TextureInput, levels: Levels) -> tuple[Float32Array, list[_Looked]]:
        """How many texels of a texture a pixel spans (m,), and the texels around the samples, level by level."""
        wraps, size = (source.wrap_s, source.wrap_t), levels.shapes[0]
        key = (source.texture, wraps)
        if (size, wraps) not in self._found:
            spanned = (self._footprint * max(size)).astype(np.float32)
            chosen = np.clip(np.round(np.log2(np.maximum(spanned, 1e-6))), 0, len(levels) - 1).astype(np.int64)
            around = []
            for number in np.flatnonzero(np.bincount(chosen)).tolist():
                at = np.flatnonzero(chosen == number)
                u, v = (axis.take(at) for axis in self._uv)
                around.append((number, at, _around(levels.shapes[number], u, v, *wraps)))
            self._found[size, wraps] = spanned, around
        spanned, around = self._found[size, wraps]
        if key not in self._found:
            looked = []
            for number, at, (places, right, down) in around:
                whole = levels[number].reshape(-1, 4).view(np.uint32)[:, 0]  # four bytes at once
                looked.append((at, [whole.take(one).view(np.uint8).reshape(-1, 4) for one in places], right, down))
            self._found[key] = looked
        return spanned, self._found[key]


def bilinear(pixels: AnyArray, uv: FloatArray, wrap_s: str = "repeat", wrap_t: str = "repeat") -> Float32Array:
    """(m, c) values of pixels (h, w, c), top row first, at UVs (m, 2) with v up."""
    places, right, down = _around(pixels.shape[:2], uv[:, 0], uv[:, 1], wrap_s, wrap_t)
    flat = pixels.reshape(-1, pixels.shape[2])
    return _mixed([flat.take(place, axis=0) for place in places], right[:, None], down[:, None])


def _around(
    shape: tuple[int, ...], u: FloatArray, v: FloatArray, wrap_s: str, wrap_t: str
) -> tuple[list[IntArray], Float32Array, Float32Array]:
    """The four texels around UVs (m,), above and below, left and right; how far samples are from the first (m,)."""
    height, width = shape
    x, y = u * width - 0.5, (1.0 - v) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    column, row = left.astype(np.int64), top.astype(np.int64)
    rows = [_wrap(each, height, wrap_t) * width for each in (row, row + 1)]
    columns = [_wrap(each, width, wrap_s) for each in (column, column + 1)]
    right, down = ((each - first).astype(np.float32) for each, first in ((x, left), (y, top)))
    return [one + other for one in rows for other in columns], right, down


def _mixed(corners: Sequence[Float32Array], right: Float32Array, down: Float32Array) -> Float32Array:
    """Values between four, each (m, ...)."""
    nw, ne, sw, se = corners
    upper, lower = nw + (ne - nw) * right, sw + (se - sw) * right
    return np.asarray(upper + (lower - upper) * down)


def _wrap(index: npt.NDArray[np.int64], size: int, mode: str) -> npt.NDArray[np.int64]:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    # a remainder takes eight times as long as the bits below a power of two
    return np.asarray(index % size if size & (size - 1) else index & (size - 1))


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Triangles of one mesh that share a material."""

    mesh: Mesh
    material: Material | None

    @property
    def see_through(self) -> bool:
        """Whether what lies behind can show through."""
        opacity = self.material.opacity if self.material else 1.0
        return not isinstance(opacity, float | int) or opacity < 1.0

    @property
    def drawn(self) -> bool:
        """False for a constant opacity of 0, or below the alpha test's threshold."""
        opacity = self.material.opacity if self.material else 1.0
        threshold = self.material.opacity_threshold if self.material else 0.0
        return not isinstance(opacity, float | int) or opacity > max(threshold, 0.0) or opacity >= 1.0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Y-up triangles with the numbers that lead back to meshes, corners and materials."""

    points: FloatArray  # (n, 3) world, Y up
    normals: FloatArray  # (n, 3) unit, outward
    triangles: IntArray  # (t, 3) point numbers, counter-clockwise outside
    corners: IntArray  # (t, 3) face-vertex numbers within the triangle's mesh
    surface: IntArray  # (t,) into surfaces
    surfaces: tuple[Surface, ...]
    first_point: IntArray  # (t,) first point of the triangle's mesh
    textures: TextureCache
    size: int  # pixels a side of the largest picture that shows it
    uv_sets: dict[str, Float32Array] = field(default_factory=dict)  # what `uv_corners` found
    like: Scene | None = None  # the same face at other points: what does not depend on these is found once

    @property
    def see_through(self) -> BoolArray:
        """(t,) triangles that need blending or an alpha test."""
        flags = np.array([surface.see_through for surface in self.surfaces], dtype=bool)
        return np.asarray(flags[self.surface])

    @property
    def double_sided(self) -> BoolArray:
        """(t,) triangles whose back is as good as their front."""
        flags = np.array([surface.mesh.double_sided for surface in self.surfaces], dtype=bool)
        return np.asarray(flags[self.surface])

    @cached_property
    def occluders(self) -> IntArray:
        """(o, 3) triangles that keep light away: solid ones, and those of cards where they are dense."""
        if self.like is not None:
            return self.like.occluders
        solid = ~self.see_through
        for number, surface in enumerate(self.surfaces):
            opacity = surface.material.opacity if surface.material else 1.0
            cards = np.flatnonzero(self.surface == number) if isinstance(opacity, TextureInput) else ()
            if len(cards) and isinstance(opacity, TextureInput):
                solid[cards] = self._mean(opacity, self.uv_corners(opacity.uv_set)[cards]) > _DENSE
        return self.triangles[solid]

    def _mean(self, opacity: TextureInput, corners: Float32Array) -> FloatArray:
        """(k,) mean of a texture over triangles with texture coordinates (k, 3, 2): a look at its coarser levels."""
        (u1, v1), (u2, v2) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
        size = np.sqrt(np.abs(u1 * v2 - u2 * v1) / 2)
        known = np.isfinite(size)
        mean = np.ones(len(corners))
        mean[known] = self.textures.sample(opacity, Places(corners[known].mean(axis=1).T, size[known]))[0][0]
        return mean

    @cached_property
    def sky_maps(self) -> SkyMaps:
        """What stands before each part of the sky; the same for all views."""
        resolution = min(max(self.size // 3, SKY_RESOLUTION // 2), SKY_RESOLUTION)
        return SkyMaps.of(self.points, self.occluders, resolution)

    @cached_property
    def sky(self) -> Sky:
        """What each point sees of the sky."""
        return self.sky_of(np.arange(len(self.points)))

    def sky_of(self, points: IntArray) -> Sky:
        """What some points see of the sky."""
        two_sided = np.zeros(len(self.points), bool)
        two_sided[self.triangles[self.double_sided]] = True
        return self.sky_maps.seen(self.points[points], self.normals[points], two_sided[points])

    @cached_property
    def facets(self) -> FloatArray:
        """(t, 3) outward vectors across the triangles, twice their areas long."""
        first, second, third = (self.points[corner] for corner in self.triangles.T)
        return np.cross(second - first, third - first)

    def uv_corners(self, name: str) -> Float32Array:
        """(t, 3, 2) texture coordinates of a UV set at the triangles' corners; NaN where the mesh lacks it."""
        if name in self.uv_sets:
            return self.uv_sets[name]
        corners = np.full((len(self.triangles), 3, 2), np.nan, np.float32)
        for number, surface in enumerate(self.surfaces):
            uv_set = next((one for one in surface.mesh.uv_sets if one.name == name), None)
            of_surface = np.flatnonzero(self.surface == number)
            if uv_set is None or not len(of_surface):
                continue
            at = self.triangles[of_surface] - self.first_point[of_surface, None]
            if uv_set.indices is not None:
                at = np.asarray(uv_set.indices, dtype=np.int64).take(self.corners.take(of_surface, axis=0))
            corners[of_surface] = np.asarray(uv_set.values).take(at, axis=0)
        self.uv_sets[name] = corners
        return corners


def world_points(parts: FaceParts, points: FloatArray | None, what: str = "points") -> FloatArray:
    """`points` (n, 3), checked against the meshes, or the neutral; turned to Y up.

    :raises InputError: the shape is not (n, 3) for the n points of all meshes, or a value is not finite
    """
    count = parts.point_count
    if points is None:
        points = np.concatenate(
            [*(transformed(mesh.points, mesh.transform) for mesh in parts.meshes), np.zeros((0, 3))]
        )
    placed = np.asarray(points, dtype=np.float64)
    if placed.shape != (count, 3):
        raise InputError(f"{parts.name} -> {what}", f"shape {placed.shape}, expected ({count}, 3)")
    if not np.isfinite(placed).all():
        bad = int(np.count_nonzero(~np.isfinite(placed).all(axis=1)))
        raise InputError(f"{parts.name} -> {what}", f"{bad} of {count} are not finite, expected finite coordinates")
    return y_up(placed, parts.up_axis)


def build_scene(parts: FaceParts, points: FloatArray | None, size: int = 800, like: Scene | None = None) -> Scene:
    """The triangles of every mesh at `points` (n, 3) world space; None: the neutral.

    :param size: pixels a side of the largest picture that shows it
    :param like: of the same parts and size at other points
    :raises InputError: points of the wrong shape or not finite
    """
    placed = world_points(parts, points)
    materials = {material.name: material for material in parts.materials}
    surfaces: list[Surface] = []
    pieces: list[tuple[IntArray, IntArray, IntArray, IntArray]] = []
    start = 0
    for mesh in parts.meshes:
        # local triangles (t, 3), their corners (t, 3) and surfaces (t,); adds the mesh's surfaces to the list. A
        # material that the face lacks, as its prim has no UsdPreviewSurface, is drawn as none.
        corners, faces = triangulate(mesh.face_vertex_counts)
        if np.linalg.det(mesh.transform[:3, :3]) < 0:
            corners = corners[:, ::-1]  # a mirrored mesh is seen from the other side of its winding
        of_face = np.full(len(mesh.face_vertex_counts), len(surfaces))
        surfaces.append(Surface(mesh=mesh, material=materials.get(mesh.material or "")))
        for bound in mesh.material_faces:
            of_face[np.asarray(bound.faces, dtype=np.int64)] = len(surfaces)
            surfaces.append(Surface(mesh=mesh, material=materials.get(bound.material)))
        triangles = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
        pieces.append((triangles + start, corners, of_face[faces], np.full(len(triangles), start)))
        start += len(mesh.points)
    empty = np.zeros((0, 3), np.int64)
    pieces.append((empty, empty, empty[:, 0], empty[:, 0]))
    triangles, corners, surface, first = (np.concatenate(group) for group in zip(*pieces, strict=True))
    normals = point_normals(placed, triangles)
    drawn = np.array([each.drawn for each in surfaces], dtype=bool)[surface]
    return Scene(
        points=placed,
        normals=_welded(placed, normals),
        triangles=triangles[drawn],
        corners=corners[drawn],
        surface=surface[drawn],
        surfaces=tuple(surfaces),
        first_point=first[drawn],
        textures=TextureCache(largest=size * 5 // 4) if like is None else like.textures,  # a face fills the picture
        size=size,
        uv_sets={} if like is None else like.uv_sets,
        like=like,
    )


def _welded(points: FloatArray, normals: FloatArray) -> FloatArray:
    """Normals shared by points at one place, so that files that split points at UV seams show no seam."""
    order = np.lexsort(points.T)  # as `numpy.unique` along an axis has it, which takes twice as long
    sorted_points = points.take(order, axis=0)
    group = np.zeros(len(points), np.int64)
    group[order[1:]] = np.cumsum((sorted_points[1:] != sorted_points[:-1]).any(axis=1))
    if not len(points) or group.max() + 1 == len(points):
        return normals
    summed = np.stack([np.bincount(group, normals[:, axis]) for axis in range(3)], axis=1)
    length = np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12)
    shared = (summed / length)[group]
    agree = np.einsum("nc,nc->n", shared, normals) > WELD_COSINE
    smooth = np.bincount(group, ~agree) == 0
    return np.where(smooth[group][:, None], shared, normals)
