"""A person's colours: materials with textures, and the cards of brows, lashes and hair."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from importlib.resources import files

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import mapped
from facepipe.heads import cards, skin
from facepipe.heads.people import IRIS, STYLES, Look
from facepipe.heads.skin import jpeg
from facepipe.parts import Color, FaceParts, Material, Mesh, Texture, TextureInput

SMALLEST = 16  # texels a side
SKIN = ("M_Face", "M_BackHead")  # of the skin's tiles
_STEP = 4  # texels from one point of the head to the next
_GREY = 0.35  # linear, the mean of the pictures of hairs
_LASHES = np.array([0.012, 0.009, 0.008])


def dressed(face: FaceParts, look: Look, size: int | None) -> FaceParts:
    """A bare head with colours, brows, lashes and hair.

    :param size: texels a side of the skin's textures; None: colours at points and no textures, so no cards of hairs
    :raises InputError: a size too small
    """
    if size is not None and size < SMALLEST:
        raise InputError("textures", f"{size} texels a side, expected 0 for none, or {SMALLEST} and more")
    head, *others = face.meshes
    if size is None:
        skins = [Material(name=name, diffuse_color=(1.0, 1.0, 1.0), roughness=0.5) for name in SKIN]
        head = replace(head, colors=_point_colors(look, head))
        return replace(face, meshes=(head, *others), materials=(*skins, *_loose(look, textured=False)))
    skins = mapped(partial(_skin, look, size), range(len(SKIN)))
    hairs = {"Brows": ("brows", "eyebrows"), "Lashes": ("lashes", "eyes"), "Hair": (look.style, "forehead")}
    materials = (*skins, *_loose(look, textured=True), *_hairs(look))
    drawn = {material.name for material in materials}
    grown = [cards.mesh(name, cards.cards(kind), head, at) for name, (kind, at) in hairs.items() if name in drawn]
    return replace(face, meshes=(*face.meshes, *grown), materials=materials)


def _point_colors(look: Look, head: Mesh) -> FloatArray:
    """(n, 3) linear colours of the head's points."""
    uv, (uv_set, *_) = np.zeros((len(head.points), 2)), head.uv_sets
    uv[head.face_vertex_indices] = np.asarray(uv_set.values)[uv_set.indices]
    tiles = np.stack([skin.coarse(look, tile, _STEP) for tile in range(len(SKIN))])
    tile, size = np.floor(uv[:, 0]).astype(int), tiles.shape[1]
    return np.asarray(tiles[tile, ((1 - uv[:, 1]) * size).astype(int), ((uv[:, 0] - tile) * size).astype(int)])


def _skin(look: Look, size: int, tile: int) -> Material:
    stem = f"skin_{skin.TILES[tile]}"
    color = jpeg(stem, skin.albedo(look, tile, size))
    packed = jpeg(f"{stem}_orm", skin.roughness(look, tile, size // 2))
    relief = jpeg(f"{stem}_normal", skin.relief(look, tile, size))
    return Material(
        name=SKIN[tile],
        diffuse_color=TextureInput(texture=color),
        roughness=TextureInput(texture=packed, channels="g"),
        occlusion=TextureInput(texture=packed, channels="r"),
        normal=TextureInput(texture=relief, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)),
        ior=1.4,
    )


def _loose(look: Look, *, textured: bool) -> list[Material]:
    """Mouth and eyes, whose pictures come with the package."""
    dim = 1 - 0.35 * look.darkness  # the white of dark people's eyes has some pigment
    iris, white = f"iris_{look.eyes}.jpg", (0.5 * dim, 0.46 * dim, 0.42 * dim)
    rows: list[tuple[str, str, Color, float, float]] = [  # material, picture, colour without it, roughness, dimmed to
        ("M_GumsTongue", "gums.jpg", (0.52, 0.20, 0.18), 0.3, 1.0),
        ("M_Teeth", "teeth.jpg", (0.74, 0.68, 0.56), 0.22, 1.0),
        *((f"M_Sclera{side}", "sclera.png", white, 0.18, dim) for side in ("Left", "Right")),
        *((f"M_Iris{side}", iris, IRIS[look.eyes], 0.4, 1.0) for side in ("Left", "Right")),
        ("Pupil", iris, (0.002, 0.002, 0.002), 0.4, 1.0),
        ("Cornea", "sclera.png", (0.0, 0.0, 0.0), 0.03, dim),
    ]
    materials = []
    for name, picture, color, roughness, factor in rows:
        scale = (factor, factor, factor, 1.0)
        diffuse = TextureInput(texture=_picture(picture), scale=scale) if textured else color
        materials.append(Material(name=name, diffuse_color=diffuse, roughness=roughness))
    clear = TextureInput(texture=_picture("sclera.png"), channels="a") if textured else 0.05
    materials[-1] = replace(materials[-1], opacity=clear, ior=1.376)
    return materials


def _hairs(look: Look) -> list[Material]:
    hair, picture = look.hair_color, STYLES[look.style][1]
    dark = min(1.0, 0.12 / hair.max(), 0.6 * look.skin.mean() / hair.mean())  # brows are darker than the skin
    brows = f"brows{int(np.clip(3 * look.brows, 0, 2))}.png"
    found = [_hair("Brows", brows, 0.8 * dark * hair + 0.05 * look.skin), _hair("Lashes", "lashes.png", _LASHES)]
    return [*found, replace(_hair("Hair", picture, hair), opacity_threshold=0.5)] if picture else found


def _hair(name: str, picture: str, color: FloatArray) -> Material:
    image, (red, green, blue) = _picture(picture), np.minimum(color / _GREY, 1.0).tolist()
    return Material(
        name=name,
        diffuse_color=TextureInput(texture=image, scale=(red, green, blue, 1.0)),
        opacity=TextureInput(texture=image, channels="a"),
        roughness=0.9 if picture == "coils.png" else 0.6,
        ior=1.35,  # the sides of cards would mirror more than hairs do
    )


def _picture(name: str) -> Texture:
    return Texture(name=name, data=(files("facepipe.heads") / "data" / name).read_bytes())
