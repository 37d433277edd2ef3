"""The colour of a person's hair in photos, for the cards of the face's hair and for the scalp below them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.core.images import open_image
from facepipe.geometry.colors import from_srgb
from facepipe.parts import Material, Mesh, TextureInput
from facepipe.processors.photo_texture.observed import GREY, Exposure, sampled
from facepipe.processors.photo_texture.seen_skin import step, to_pixels
from facepipe.processors.photo_texture.skin_surface import SkinSurface

# lengths are shares of the eyes' distance
_ABOVE = 0.3  # over the brows: there the highest point of cards of hair is, and none of brows and lashes
_NEAR = 1.0  # off the landmarks inside the face
_BEHIND = 0.1  # in depth: what is so far behind the surface is hidden
_RIM = 3.0  # pixels off outlines
_ROOTS = (0.03, 0.10)  # off the cards: where the scalp has their colour, where it has none
_PAINTED = 0.6  # of the skin's brightness: below it a template is painted with hair
_UNLIKE = np.array([0.35, 0.12, 0.12])  # brightness and two hues, as logarithms: beyond them hair is no skin
_CLEAR, _OTHER = 0.2, 0.5  # of the places of hair: with hair that is darker or brighter than skin, or of another hue
_FEWEST = 20
_DARKEST, _BRIGHTEST = 0.01, 0.7  # linear


@dataclass(frozen=True, kw_only=True)
class Hair:
    """Points of cards of hair."""

    neutral: FloatArray  # (k, 3) world, the neutral person
    posed: tuple[FloatArray, ...]  # of each photo (k, 3) in camera coordinates


@dataclass(frozen=True, kw_only=True)
class HairCards:
    """The mesh of a face's hair."""

    material: Material
    span: slice  # its points among those of all meshes

    def among(self, neutral: FloatArray, posed: Sequence[FloatArray]) -> Hair:
        """Its points among those (n, 3) of all meshes: of the neutral person, and in each photo's camera."""
        return Hair(neutral=neutral[self.span], posed=tuple(points[self.span] for points in posed))


def hair_cards(
    skin: SkinSurface, meshes: Sequence[Mesh], materials: Sequence[Material], points: FloatArray
) -> HairCards | None:
    """The cards that reach far above the brows; None where a face has none.

    :param points: (n, 3) of all meshes, the neutral person
    """
    marks = skin.points[skin.landmarks]
    up = (marks[27] - marks[8]) / np.linalg.norm(marks[27] - marks[8])
    least = (marks[17:27] @ up).max() + _ABOVE * skin.eye_distance(skin.points)
    named, first = {material.name: material for material in materials}, 0
    for mesh in meshes:
        span = slice(first, first + len(mesh.points))
        first = span.stop
        material = named.get(mesh.material or "")
        if material is None or not isinstance(material.opacity, TextureInput):
            continue
        if isinstance(material.diffuse_color, TextureInput) and (points[span] @ up).max() > least:
            return HairCards(material=material, span=span)
    return None


def hair_color(
    skin: SkinSurface, hair: Hair, photos: Sequence[Exposure], scales: Sequence[FloatArray], color: FloatArray
) -> FloatArray | None:
    """(3,) linear colour of hair, the median of what is seen near the face and is no skin; None where little is.

    Skin at the edge of hair may lie in other light than fitted: what differs in brightness must do so to one side.

    :param scales: (3,) of each photo's light
    :param color: (3,) linear, of the skin
    """
    colors = np.concatenate(
        [
            _behind_cards(photo, photo.points[skin.landmarks], points) / scale
            for photo, points, scale in zip(photos, hair.posed, scales, strict=True)
        ]
    )
    off = np.log(np.maximum(colors, 1e-4)) - np.log(color)
    levels = np.column_stack([off @ GREY, off[:, 0] - off[:, 1], off[:, 2] - off[:, 1]])
    dark, bright = levels[:, 0] < -_UNLIKE[0], levels[:, 0] > _UNLIKE[0]
    clear = dark if dark.sum() >= bright.sum() else bright
    other = (np.abs(levels) > _UNLIKE).any(axis=1)
    chosen = next((one for one, least in ((clear, _CLEAR), (other, _OTHER)) if one.sum() >= least * len(one)), None)
    if chosen is None or chosen.sum() < _FEWEST:
        return None
    far = np.abs(levels[chosen] / _UNLIKE).max(axis=1)  # of strands over skin, those that hide most of it
    clear_hair = off[chosen][far >= np.median(far)]
    return np.asarray(np.clip(np.exp(np.median(clear_hair, axis=0)) * color, _DARKEST, _BRIGHTEST))


def _behind_cards(photo: Exposure, marks: FloatArray, hair: FloatArray) -> FloatArray:
    """(m, 3) linear colours over the light at places of hair (k, 3) that a photo shows, near landmarks (68, 3)."""
    near = cKDTree(marks[17:]).query(hair)[0] < _NEAR * photo.seen.eye_distance
    places, depth = to_pixels(photo.view, hair)
    height, width = photo.seen.depth.shape
    inside = ((places > 2) & (places < np.array([width, height]) - 2)).all(axis=1) & near
    places, depth, hair = places[inside], depth[inside], hair[inside]
    if not len(hair):
        return np.zeros((0, 3))
    column, row = places.astype(np.int64).T
    behind = photo.seen.depth[row, column]  # beside the head there is none: another's hair, or a wall
    seen = np.isfinite(behind) & (depth <= behind + _BEHIND * photo.seen.eye_distance)
    seen &= photo.seen.outline[row, column] > _RIM
    if not seen.any():
        return np.zeros((0, 3))
    _, nearest = cKDTree(photo.points).query(hair[seen])
    white = photo.white[nearest]
    return np.asarray(from_srgb(np.clip(sampled(photo.pixels, places[seen], 2.0), 0, 1)) / np.maximum(white, 0.05))


def scale_of(material: Material, color: FloatArray) -> tuple[float, float, float, float]:
    """The scale at which the picture of a material's cards has a mean linear colour (3,)."""
    source = material.diffuse_color
    assert isinstance(source, TextureInput)
    image = open_image(source.texture.image(), f"texture {source.texture.name}").convert("RGBA")
    values = np.asarray(image, np.float32) / np.float32(255)
    mean = np.average(from_srgb(values[..., :3]).reshape(-1, 3), axis=0, weights=values[..., 3].ravel() + 1e-6)
    red, green, blue = np.minimum(color / np.maximum(mean, 1e-3), 1.0).tolist()
    return red, green, blue, 1.0


def scalp(skin: SkinSurface, template: FloatArray, roots: FloatArray) -> FloatArray:
    """(n,) 0..1 how far points of the skin are painted with hair.

    :param template: (n, 3) logarithms of linear colours
    :param roots: (k, 3) points of cards, the neutral person
    """
    distance = cKDTree(roots).query(skin.points)[0] / skin.eye_distance(skin.points)
    bright = np.exp(template @ GREY)
    level = np.median(bright[skin.landmarks[27:36]])
    return np.asarray((1 - step(distance, *_ROOTS)) * (bright < _PAINTED * level))


def scalp_color(hair: FloatArray, skin: FloatArray) -> FloatArray:
    """(3,) linear colour of a scalp below hair, as `facepipe.heads.skin` paints it."""
    return np.asarray(np.minimum(0.8 * hair + 0.03 * skin, 0.15 * hair + 0.55 * skin))
