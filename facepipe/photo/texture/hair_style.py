"""The style of the built-in head's hair that comes nearest to the hair in photos."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.ndimage import zoom

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.images import open_image
from facepipe.geometry.rasterise import rasterise, screen_triangles
from facepipe.heads.people import STYLES
from facepipe.heads.surfaces import card_triangles, cards, picture_of
from facepipe.textures.observed import Exposure
from facepipe.textures.seen_skin import to_camera, to_pixels
from facepipe.textures.skin_surface import SkinSurface

_EYES = 24  # pixels between the eyes, at which hair is compared
_SCALP = 0.5
_TEXELS = 32  # a side, of which each covers some strands and the gaps between them
_SHAVED = 0.8  # of the scalp's pixels, that show face where nothing of hair is
_LEAST = 0.2  # of all pixels of hair, that the nearest style shares with photos


def nearest_style(
    skin: SkinSurface, photos: Sequence[Exposure], posed: Sequence[FloatArray], scalp: FloatArray, now: str
) -> str:
    """The style whose outlines share most with the hair in photos; that of now where none shares much.

    Bald is whose scalp shows as face. Outlines do not tell curls: hair stays straight, or curled, as it is.

    :param posed: of each photo (n, 3) world points of the skin
    :param scalp: (n,) how far points of the skin are scalp
    :param now: the style that the face has
    """
    hair, face = ([_small(photo, kind) for photo in photos] for kind in ("hair", "face"))

    def drawn(style: str) -> list[BoolArray]:
        return [_drawn(skin, *one, scalp > _SCALP, style) for one in zip(photos, posed, strict=True)]

    shaved = drawn("stubble")
    if _sum(np.minimum, face, shaved) > _SHAVED * sum(map(np.sum, shaved)):
        return "bald"
    shares = {now: _LEAST}
    for style, (painted, picture) in STYLES.items():
        if painted and picture in ("", STYLES[now][1]):
            shown = drawn(style)
            # Intersection over union: by what is shared alone, the largest outline would win.
            share = _sum(np.minimum, hair, shown) / max(_sum(np.maximum, hair, shown), 1e-9)
            shares[style] = max(shares.get(style, 0.0), share)
    return max(shares, key=lambda style: shares[style])


def _sum(kind: np.ufunc, one: Sequence[FloatArray], other: Sequence[BoolArray]) -> float:
    return float(sum(kind(*pair).sum() for pair in zip(one, other, strict=True)))


@cache
def _dense_triangles(style: str) -> IntArray:
    """(t, 3) of a style's cards, where their picture shows more hair than gaps."""
    grown, picture = cards(style), picture_of(STYLES[style][1])
    small = open_image(picture.image(), picture.name).convert("RGBA").getchannel("A").resize((_TEXELS, _TEXELS))
    triangles = card_triangles(grown)
    column, row = (grown.uv[triangles].mean(axis=1) * [1, -1] % 1 * _TEXELS).astype(int).T
    return np.asarray(triangles[np.asarray(small)[row, column] > 127])


def _scale(photo: Exposure) -> float:
    """Of small pictures."""
    return min(1.0, _EYES / photo.eye_pixels)


def _small(photo: Exposure, kind: str) -> FloatArray:
    """(h, w) face or hair in a small picture."""
    whole, scale = getattr(photo.seen.mask, kind), _scale(photo)
    shares = [max(1, round(side * scale)) / side for side in whole.shape]
    return np.asarray(zoom(whole, shares, order=1, mode="nearest", grid_mode=True))


def _drawn(skin: SkinSurface, photo: Exposure, points: FloatArray, scalp: BoolArray, style: str) -> BoolArray:
    """(h, w) where a style shows in a small picture."""
    shown, triangles = photo.all_points, skin.opaque
    hair = np.zeros(len(shown), bool)
    hair[skin.span] = scalp & (STYLES[style][0] > 0)
    if STYLES[style][1]:
        grown = cards(style)
        triangles = np.concatenate([triangles, _dense_triangles(style) + len(shown)])
        shown = np.concatenate([shown, to_camera(photo.view, grown.carry(points) + grown.offsets)])
        hair = np.concatenate([hair, np.ones(len(grown.uv), bool)])
    places, depth = to_pixels(photo.view, shown)
    scale = _scale(photo)
    flat = np.column_stack([places * scale * depth[:, None], np.ones(len(depth)), depth])
    height, width = (max(1, round(side * scale)) for side in photo.seen.depth.shape)
    raster = rasterise(screen_triangles(flat, triangles), width, height)
    of_hair = np.asarray(hair[triangles].all(axis=1))
    return np.asarray((raster.key > 0) & of_hair[np.maximum(raster.triangle, 0)])
