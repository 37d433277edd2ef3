"""Colours of a mesh's points, from its own, its textures or its materials."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.images import open_image, pixels
from facepipe.geometry.colors import from_srgb
from facepipe.parts import Material, Mesh, Texture, TextureInput, UvSet

_TEXELS = 8  # a point: beyond, a texture holds pores that points can only make noise of


def point_colors(mesh: Mesh, materials: dict[str, Material]) -> FloatArray | None:
    """(n, 3) linear colours of the points; None where the mesh has neither colours nor a coloured material.

    :raises InputError: a texture that is no image
    """
    if mesh.colors is not None:
        return np.clip(np.asarray(mesh.colors, dtype=np.float64), 0.0, 1.0)
    corner = _corners(mesh)
    named = [(one.material, one.faces) for one in mesh.material_faces]
    faces = np.repeat(np.arange(len(mesh.face_vertex_counts)), mesh.face_vertex_counts)
    colors = np.full((len(mesh.points), 3), np.nan)
    for name, own in [(mesh.material, None), *named]:
        if name is None or name not in materials:
            continue
        among = np.ones(len(mesh.face_vertex_counts), bool)
        if own is not None:
            among[:] = False
            among[own] = True
        at = np.flatnonzero((corner >= 0) & among[faces[corner]])
        found = _material_colors(mesh, materials[name], at, corner[at])
        if found is not None:
            colors[at] = found
    missing = np.isnan(colors[:, 0])
    if missing.all():
        return None
    colors[missing] = 0.18
    return np.asarray(np.clip(colors, 0.0, 1.0))


def _corners(mesh: Mesh) -> IntArray:
    """(n,) a face corner of every point, the first; -1 for points of no face."""
    points, first = np.unique(mesh.face_vertex_indices, return_index=True)
    corner = np.full(len(mesh.points), -1, np.int64)
    corner[points] = first
    return corner


def _material_colors(mesh: Mesh, material: Material, points: IntArray, corners: IntArray) -> FloatArray | None:
    """(k, 3) colours at `points`."""
    color = material.diffuse_color
    if not isinstance(color, TextureInput):
        return np.tile(color, (len(points), 1))
    uv_set = next((one for one in mesh.uv_sets if one.name == color.uv_set), None)
    if uv_set is None:
        return None
    texels = _texels(color.texture, _TEXELS * len(mesh.points))
    texel = _sampled(texels, _uvs(uv_set, points, corners))
    return np.asarray(texel * np.array(color.scale[:3]) + np.array(color.bias[:3]))


def _uvs(uv_set: UvSet, points: IntArray, corners: IntArray) -> FloatArray:
    values = np.asarray(uv_set.values, dtype=np.float64)
    return np.asarray(values[points] if uv_set.indices is None else values[uv_set.indices[corners]])


def _texels(texture: Texture, most: int) -> FloatArray:
    """(h, w, 3) linear pixels, top row first, averaged down to about `most`.

    :raises InputError: no image, or one too large
    """
    where = f"texture {texture.name}"
    image = open_image(texture.data, where)
    factor = int(np.sqrt(image.width * image.height / max(most, 1)))
    return from_srgb(pixels(image, "RGB", where, max(factor, 1)) / 255.0)


def _sampled(pixels: FloatArray, uv: FloatArray) -> FloatArray:
    """(k, 3) bilinear values at UVs (k, 2), v up; textures repeat."""
    height, width = pixels.shape[:2]
    x, y = uv[:, 0] % 1.0 * width - 0.5, (1.0 - uv[:, 1]) % 1.0 * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    across, down = (x - left)[:, None], (y - top)[:, None]
    columns, rows = (left % width, (left + 1) % width), (top % height, (top + 1) % height)
    upper = pixels[rows[0], columns[0]] * (1 - across) + pixels[rows[0], columns[1]] * across
    lower = pixels[rows[1], columns[0]] * (1 - across) + pixels[rows[1], columns[1]] * across
    return np.asarray(upper * (1 - down) + lower * down)
