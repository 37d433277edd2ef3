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
from facepipe.textures.seen_skin import GREY, Exposure, step
from facepipe.textures.skin_surface import SkinSurface

# lengths are shares of the eyes' distance
_ABOVE = 0.3  # over the brows: there the highest point of cards of hair is, and none of brows and lashes
_ROOTS = (0.03, 0.10)  # off the cards: where the scalp has their colour, where it has none
_PAINTED = 0.6  # of the skin's brightness: below it a template is painted with hair
_CLEAR = 0.7  # share of a pixel that is hair, or face, by the network of masks
_LEAST = 0.05  # of the pixels of a face, that are hair
_LIT = 0.7  # quantile: strands that are darker lie in the shade of others
_SEEN = 0.5  # confidence in skin whose light counts
_TOWARDS = 0.2  # cosine to the viewer of scalp whose light counts
_DARKEST, _BRIGHTEST = 0.01, 0.7  # linear


@dataclass(frozen=True, kw_only=True)
class HairCards:
    """The mesh of a face's hair."""

    mesh: Mesh
    material: Material
    span: slice  # its points among those of all meshes


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
            return HairCards(mesh=mesh, material=material, span=span)
    return None


def hair_color(photos: Sequence[Exposure], scales: Sequence[FloatArray], scalp: FloatArray) -> FloatArray | None:
    """(3,) linear colour of hair as photos show it in the light that falls there; None where that is little.

    :param scales: (3,) of each photo's light
    :param scalp: (n,) how far points are painted with hair
    """
    known = []
    for photo, scale in zip(photos, scales, strict=True):
        mask, lit = photo.seen.mask, photo.trust > _SEEN
        clear = mask.hair > _CLEAR
        if not lit.any() or not clear.any() or clear.sum() < _LEAST * (mask.face > _CLEAR).sum():
            continue
        # The face's light, or the scalp's where that is brighter: most lamps hang above, and the scalp of the face is
        # in the shade of cards whose style the person may not have.
        light = np.median(photo.white[lit], axis=0)
        above = (scalp > _SEEN) & (photo.facing > _TOWARDS)
        if above.any():
            light = light * max(1.0, float(np.median(photo.white[above] @ GREY)) / float(light @ GREY))
        known.append(from_srgb(photo.pixels[clear].astype(np.float64)) / light / scale)
    return np.clip(np.quantile(np.concatenate(known), _LIT, axis=0), _DARKEST, _BRIGHTEST) if known else None


def scale_of(material: Material, color: FloatArray) -> tuple[float, float, float, float]:
    """The scale at which the picture of a material's cards has a mean linear colour (3,)."""
    source = material.diffuse_color
    assert isinstance(source, TextureInput)
    image = open_image(source.texture.image(), f"texture {source.texture.name}").convert("RGBA")
    values = np.asarray(image, np.float32) / np.float32(255)
    mean = np.average(from_srgb(values[..., :3]).reshape(-1, 3), axis=0, weights=values[..., 3].ravel() + 1e-6)
    red, green, blue = np.minimum(color / np.maximum(mean, 1e-3), 1.0).tolist()
    return red, green, blue, 1.0


def painted_scalp(skin: SkinSurface, template: FloatArray, roots: FloatArray) -> FloatArray:
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
    return np.asarray(np.minimum(0.5 * hair + 0.002 * skin, 0.15 * hair + 0.55 * skin))
