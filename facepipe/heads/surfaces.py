"""The materials of a person, with textures made for them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads import cards, skin
from facepipe.heads.look import IRIS, Look
from facepipe.heads.pixels import texture
from facepipe.parts import FaceParts, Material, Mesh, Texture, TextureInput

SKIN = ("M_Face", "M_BackHead")  # of the tiles
_NORMAL = {"scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
SCALP = {
    "bald": 0.0,
    "stubble": 0.5,
    "crop": 0.9,
    "parted": 0.9,
    "bob": 0.9,
    "long": 0.9,
    "coils": 0.97,
}  # that hair colours
_MEAN = 0.35  # linear, of the grey in pictures of hairs


def materials(look: Look, size: int) -> tuple[Material, ...]:
    """Skin, eyes, mouth and hairs.

    :param size: texels a side of the skin's colour and relief
    """
    white, iris = _picture("sclera.png"), TextureInput(texture=_picture(f"iris_{look.eyes}.jpg"))
    dim = 1 - 0.35 * look.darkness  # the white of dark people's eyes has some pigment
    color = TextureInput(texture=white, scale=(dim, dim, dim * 0.97, 1.0))
    brows = f"brows{int(np.clip(3 * look.brows, 0, 2))}.png"
    with ThreadPoolExecutor(len(SKIN)) as pool:
        skins = pool.map(partial(_skin, look, size), range(len(SKIN)))
    found = [
        *skins,
        Material(name="M_GumsTongue", diffuse_color=_input(_picture("gums.jpg")), roughness=0.3),
        Material(name="M_Teeth", diffuse_color=_input(_picture("teeth.jpg")), roughness=0.22),
        *(Material(name=f"M_Sclera{side}", diffuse_color=color, roughness=0.18) for side in ("Left", "Right")),
        *(Material(name=f"M_Iris{side}", diffuse_color=iris, roughness=0.4) for side in ("Left", "Right")),
        Material(name="Pupil", diffuse_color=iris, roughness=0.4),
        Material(
            name="Cornea",
            diffuse_color=color,
            opacity=TextureInput(texture=white, channels="a"),
            roughness=0.03,
            ior=1.376,
        ),
        _hairs("Brows", brows, _brow_color(look)),
        _hairs("Lashes", "lashes.png", np.array([0.012, 0.009, 0.008])),
    ]
    if look.style in HAIR:
        found.append(_hairs("Hair", HAIR[look.style], look.hair_color, cut=0.5))
    return tuple(found)


HAIR = {"crop": "hair.png", "parted": "hair.png", "bob": "hair.png", "long": "hair.png", "coils": "coils.png"}


def dressed(face: FaceParts, look: Look, size: int | None) -> FaceParts:
    """A bare head with colours, brows, lashes and hair.

    :param size: texels a side of the skin's textures; None: colours at points and no textures, so no cards of hairs
    """
    head, *others = face.meshes
    if size is None:
        colored = replace(head, colors=point_colors(look, head))
        return replace(face, meshes=(colored, *others), materials=plain(look))
    return replace(face, meshes=(head, *others, *meshes(look, head)), materials=materials(look, size))


def meshes(look: Look, head: Mesh) -> tuple[Mesh, ...]:
    """Brows, lashes and hair on a head."""
    kinds = [("Brows", "brows", "eyebrows"), ("Lashes", "lashes", "eyes")]
    kinds += [("Hair", look.style, "forehead")] * (look.style in HAIR)
    return tuple(cards.mesh(name, cards.cards(kind), head, region, name) for name, kind, region in kinds)


def plain(look: Look) -> tuple[Material, ...]:
    """Materials without textures; the skin's white is that of the colours at points."""
    white, iris = (0.5, 0.46, 0.42), IRIS[look.eyes]
    return (
        *(Material(name=name, diffuse_color=(1.0, 1.0, 1.0), roughness=0.5) for name in SKIN),
        Material(name="M_GumsTongue", diffuse_color=(0.42, 0.14, 0.13), roughness=0.3),
        Material(name="M_Teeth", diffuse_color=(0.66, 0.60, 0.48), roughness=0.22),
        *(Material(name=f"M_Sclera{side}", diffuse_color=white, roughness=0.18) for side in ("Left", "Right")),
        *(Material(name=f"M_Iris{side}", diffuse_color=iris, roughness=0.3) for side in ("Left", "Right")),
        Material(name="Pupil", diffuse_color=(0.002, 0.002, 0.002), roughness=0.1),
        Material(name="Cornea", diffuse_color=(0.0, 0.0, 0.0), opacity=0.05, roughness=0.03, ior=1.376),
    )


def point_colors(look: Look, head: Mesh) -> FloatArray:
    """(n, 3) linear colours of the head's points, for a head without textures."""
    uv, (uv_set, *_) = np.zeros((len(head.points), 2)), head.uv_sets
    uv[head.face_vertex_indices] = np.asarray(uv_set.values)[uv_set.indices]
    tiles = np.stack([skin.coarse(look, tile, SCALP[look.style]) for tile in (0, 1)])
    tile, size = np.floor(uv[:, 0]).astype(int), tiles.shape[1]
    return np.asarray(tiles[tile, ((1 - uv[:, 1]) * size).astype(int), ((uv[:, 0] - tile) * size).astype(int)])


def _brow_color(look: Look) -> FloatArray:
    return np.asarray(
        look.hair_color * min(1.0, 0.12 / look.hair_color.max(), 0.6 * look.skin.mean() / look.hair_color.mean())
    )


def _skin(look: Look, size: int, tile: int) -> Material:
    stem, scalp = f"skin_{skin.TILES[tile]}", SCALP[look.style]
    packed = texture(f"{stem}_orm.jpg", skin.roughness(look, tile, size // 2))
    return Material(
        name=SKIN[tile],
        diffuse_color=_input(texture(f"{stem}.jpg", skin.albedo(look, tile, size, scalp))),
        roughness=_input(packed, channels="g"),
        occlusion=_input(packed, channels="r"),
        normal=_input(texture(f"{stem}_normal.jpg", skin.relief(look, tile, size)), **_NORMAL),
        ior=1.4,
    )


def _input(image: Texture, **how: Any) -> TextureInput:
    return TextureInput(texture=image, **how)


def _hairs(name: str, picture: str, color: FloatArray, cut: float = 0.0) -> Material:
    image = _picture(picture)
    red, green, blue = np.minimum(color / _MEAN, 1.0).tolist()
    return Material(
        name=name,
        diffuse_color=TextureInput(texture=image, scale=(red, green, blue, 1.0)),
        opacity=TextureInput(texture=image, channels="a"),
        opacity_threshold=cut,
        roughness=0.85,
        ior=1.25,  # the sides of cards would mirror more than hairs do
    )


def _picture(name: str) -> Texture:
    return Texture(name=name, data=(files("facepipe.heads") / "data" / name).read_bytes())
