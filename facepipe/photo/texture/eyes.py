"""The colours of eyes in photos: irises for the picture of a face's own, and their whites, which tell of the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.images import open_image
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import triangulate
from facepipe.parts import FaceParts, Mesh
from facepipe.textures.observed import DARKEST, GREY, Exposure, sampled
from facepipe.textures.seen_skin import to_pixels
from facepipe.textures.skin_surface import (
    SkinTexture,
    names_of,
    of_faces,
    template_texels,
    textures_of,
)

SCHEME = "pupils"
_TEXELS = 96  # a side of the picture as it is compared
_FRONT = 0.012  # of the eyes' distance: a point so far behind the nearest surface is hidden
_PUPIL = 0.3  # of the iris' median brightness: what is darker is the pupil
_FEWEST, _SMALLEST = 60, 4.0  # texels, and pixels across that an iris is seen by
_IRIS_SHARE, _WHITE_SHARE = (0.0, 0.5), (0.3, 0.9)  # quantiles of brightness: what is brighter mirrors lamps
_IRIS_LIMITS, _WHITE_LIMITS = (0.2, 4.0), (0.5, 1.0)  # factors
_WHITES = 0.5, 0.9  # quantiles of brightness between which whites of eyes are


@dataclass(frozen=True, kw_only=True)
class EyeColor:
    """How much lighter irises, or the whites of eyes, are than in their picture."""

    texture: SkinTexture
    materials: tuple[str, ...]  # that show it, of both eyes
    factor: FloatArray  # (3,) of its linear colours


def eye_colors(parts: FaceParts, photos: Sequence[Exposure], scales: Sequence[FloatArray]) -> tuple[EyeColor, ...]:
    """Those of irises and of whites, without what no photo shows enough of, or has no picture in common.

    :param scales: (3,) of each photo's light
    """
    found = (_eye_color(parts, photos, scales, white=white) for white in (False, True))
    return tuple(one for one in found if one is not None)


def _eye_color(
    parts: FaceParts, photos: Sequence[Exposure], scales: Sequence[FloatArray], *, white: bool
) -> EyeColor | None:
    found: list[FloatArray] = [np.zeros((0, 3))]
    textures, first = [], 0
    for mesh in parts.meshes:
        texture = _texture(parts, mesh, white=white)
        if texture is not None:
            textures.append(texture)
            for photo, scale in zip(photos, scales, strict=True):
                around = photo.light_around(slice(first, first + len(mesh.points)))
                found.append(_ratios(photo, texture, first, around) - np.log(scale))
        first += len(mesh.points)
    ratios, names = np.concatenate(found), {texture.source.texture.name for texture in textures}
    if len(ratios) < _FEWEST or len(names) > 1:
        return None
    bright = ratios @ GREY
    low, high = np.quantile(bright, _WHITE_SHARE if white else _IRIS_SHARE)
    ratio = np.median(ratios[(bright >= low) & (bright <= high)], axis=0)
    if white:  # lids in their place would redden them
        ratio = np.full(3, ratio @ GREY)
    materials = tuple(dict.fromkeys(name for texture in textures for name in texture.materials))
    factor = np.clip(np.exp(ratio), *(_WHITE_LIMITS if white else _IRIS_LIMITS))
    return EyeColor(texture=textures[0], materials=materials, factor=factor)


def eye_whites(parts: FaceParts, photo: Exposure) -> FloatArray | None:
    """(3,) logarithms of how much lighter than in its light a photo shows whites of eyes; None: hardly any."""
    found: list[FloatArray] = [np.zeros((0, 3))]
    first = 0
    for mesh in parts.meshes:
        texture = _texture(parts, mesh, white=True)
        if texture is not None:
            found.append(_ratios(photo, texture, first))
        first += len(mesh.points)
    ratios = np.concatenate(found)
    if len(ratios) < _FEWEST:
        return None
    bright = ratios @ GREY  # lids and lashes shade the darker half, lamps' images are few
    low, high = np.quantile(bright, _WHITES)
    return np.asarray(np.median(ratios[(bright >= low) & (bright <= high)], axis=0))


def _texture(parts: FaceParts, mesh: Mesh, *, white: bool = False) -> SkinTexture | None:
    """That of an eye's iris: what is next to the middle of its pupil, and lets no light through.

    :param white: the other one
    """
    if SCHEME not in mesh.landmarks:
        return None
    solid = {material.name for material in parts.materials if material.opacity == 1.0}
    names, number = names_of(mesh), of_faces(mesh)
    corners, faces = triangulate(mesh.face_vertex_counts)
    middles = mesh.points[mesh.face_vertex_indices[corners]].mean(axis=1)
    off = np.linalg.norm(middles - mesh.points[mesh.landmarks[SCHEME].indices[0]], axis=1)
    off[[names[place] not in solid for place in number[faces]]] = np.inf
    shown = names[number[faces[off.argmin()]]]
    return next((one for one in textures_of(parts, mesh, _TEXELS) if (shown in one.materials) != white), None)


def _ratios(photo: Exposure, texture: SkinTexture, first: int, light: FloatArray | None = None) -> FloatArray:
    """(m, 3) logarithms of colours over the template's, of texels of the iris that a photo shows.

    :param first: point of the eye among those of all meshes
    :param light: (3,) there; None: that of each point
    """
    texels, template = texture.texels, template_texels(texture).reshape(-1, 3)[texture.texels.at]
    span = slice(first, first + int(texels.corners.max()) + 1)
    places, depth = to_pixels(photo.view, texels.carried(photo.all_points[span]))
    across = np.ptp(places, axis=0).max()
    bright = template @ GREY
    height, width = photo.seen.depth.shape
    column, row = np.clip(places, 0, [width - 1, height - 1]).astype(np.int64).T
    seen = depth <= photo.seen.depth[row, column] + _FRONT * photo.seen.eye_distance
    # Without the pupil: ratios to its black say nothing of the iris's colour.
    seen &= bright > _PUPIL * np.median(bright)
    seen &= ((places > 2) & (places < np.array([width, height]) - 2)).all(axis=1)
    if across < _SMALLEST or not seen.any():
        return np.zeros((0, 3))
    shown = from_srgb(np.clip(sampled(photo.pixels, places[seen], 1.0), 0, 1))
    white = texels.taken(np.flatnonzero(seen)).carried(photo.all_white[span]) if light is None else light
    white = np.maximum(white, DARKEST)
    return np.asarray(np.log(np.maximum(shown, DARKEST) / white) - np.log(np.maximum(template[seen], DARKEST)))


def recolored(texture: SkinTexture, factor: FloatArray) -> bytes:
    """The picture of a texture with its linear colours times a factor (3,), as PNG."""
    from PIL import Image

    name = texture.source.texture.name
    picture = open_image(texture.source.texture.image(), f"texture {name}").convert("RGB")
    linear = from_srgb(np.arange(256, dtype=np.float32)[:, None] / np.float32(255)) * factor
    levels = (to_srgb(np.clip(linear, 0, 1)) * 255 + 0.5).astype(np.uint8)  # of 256 levels, not of a million texels
    stream = BytesIO()
    Image.fromarray(levels[np.asarray(picture), np.arange(3)]).save(stream, format="PNG", compress_level=6)
    return stream.getvalue()
