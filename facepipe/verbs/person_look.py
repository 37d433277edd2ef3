"""How a person of a payload looks: skin, hair and eyes of the built-in head, or small pictures of its own."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.images import open_image
from facepipe.geometry.colors import from_srgb
from facepipe.heads.people import BEARDS, HAIR, IRIS, STYLES, TONES, Look, draw
from facepipe.heads.surfaces import HAIR_GREY, SKIN, cards, dressed, kind_of, other_cards
from facepipe.parts import FaceParts, Material, Mesh, TextureInput
from facepipe.stage import Face
from facepipe.stage.author_changes import author_mesh_in_place
from facepipe.stage.materials import author_color_scale, author_opacity

_FIELDS = ("diffuse_color", "roughness", "occlusion", "normal", "opacity")
_ON_CARDS = [name for name, (_, picture) in STYLES.items() if picture]
_BEARDS_ON_CARDS = [name for name, painted in BEARDS.items() if painted]
_MOVED = 1.0  # cm that hair may lie beside where it was laid
_QUALITY = 80  # of WebP
_NEAR = 1e-4  # of a picture's side
_SMALL = 64  # texels a side, by which a tone is told


def look_of(parts: FaceParts) -> Look:
    """What a face of the built-in head looks like: as its seed says, with hair, eyes and tone as it shows them."""
    if parts.recipe is not None and parts.recipe.verb == "sample":
        given = [parts.recipe.options.get(name) for name in ("seed", "age", "feminine")]
        seed, years, feminine = (one if isinstance(one, int | float) else None for one in given)
        if seed is not None and seed >= 0:
            return draw(int(seed), years=years, feminine=feminine).look
    look, materials = Look(), {one.name: one for one in parts.materials}
    meshes = {mesh.name: mesh for mesh in parts.meshes}
    style, beard = _cut(meshes.get("Hair"), _ON_CARDS), _cut(meshes.get("Beard"), _BEARDS_ON_CARDS)
    shown = "Hair" in materials and not _is_clear(materials["Hair"])
    look = replace(look, style=style if style and shown else "bald", whiskers=beard or "stubble")
    color = _scale(materials.get("Hair"))
    if color is not None:
        pairs = [(name, grey) for name in HAIR for grey in np.linspace(0, 1, 21).tolist()]
        near = [np.abs(np.log(replace(look, hair=h, grey=g).hair_color / HAIR_GREY / color)).sum() for h, g in pairs]
        hair, grey = pairs[int(np.argmin(near))]
        look = replace(look, hair=hair, grey=grey)
    iris = _texture(materials.get("M_IrisLeft"))
    names = [name for name in IRIS if iris is not None and f"_{name}" in iris.texture.name]
    skin = _texture(materials.get(SKIN[0]))
    if skin is not None:
        picture = open_image(skin.texture.image(), skin.texture.name).convert("RGB").resize((_SMALL, _SMALL))
        mean = np.median(from_srgb(np.asarray(picture, np.float64).reshape(-1, 3) / 255), axis=0)
        tones = np.linspace(1, TONES, 181).tolist()
        off = [np.abs(np.log(replace(look, tone=tone).skin / mean)).sum() for tone in tones]
        look = replace(look, tone=tones[int(np.argmin(off))])
    return replace(look, eyes=names[0] if names else look.eyes)


def author_look(face: Face, look: Look) -> tuple[str, ...]:
    """Dress a face of the built-in head within `Face.deriving`; one line for what it has no place for.

    :param look: with names that this head has
    """
    parts = face.parts_so_far()
    before, own = {one.name: one for one in parts.materials}, _texture(_material(parts, SKIN[0]))
    if own is None:
        return ("look: the face has no textures, expected those of `facepipe sample`",)
    size = open_image(own.texture.image(), own.texture.name).size[0]
    head, warnings = parts.meshes[0], list[str]()
    if BEARDS[look.whiskers] and all(mesh.name != "Beard" for mesh in parts.meshes):
        warnings.append(f"look: the face has no mesh Beard for a {look.whiskers}, which is left out")
        look = replace(look, whiskers="stubble")  # else skin would be dark below hair that is not there
    bare = tuple(mesh for mesh in parts.meshes if mesh.material not in ("Brows", "Lashes", "Hair", "Beard"))
    made = dressed(replace(parts, meshes=bare), look, size)
    for material in made.materials:
        if material.name in before:
            _author_material(face, before[material.name], material)
    for name, kind, drawn in (
        ("Hair", look.style, STYLES[look.style][1]),
        ("Beard", look.whiskers, BEARDS[look.whiskers]),
    ):
        mesh = next((one for one in parts.meshes if one.name == name), None)
        if mesh is None:
            continue
        if not drawn:
            author_opacity(_prim(face, name), 0.0)
        elif kind_of(mesh, head, _MOVED) != kind:
            author_mesh_in_place(face, other_cards(mesh, kind, head))
    return tuple(warnings)


def pictures_of(parts: FaceParts, size: int) -> tuple[tuple[str, bytes], ...]:
    """Materials of the skin, and their colours as WebP with so many texels a side.

    :raises InputError: no textures
    """
    found = []
    for name in SKIN:
        own = _texture(_material(parts, name))
        if own is None:
            raise InputError(parts.name, f"material {name} has no texture, expected one for --textures")
        picture = (
            open_image(own.texture.image(), own.texture.name)
            .convert("RGB")
            .resize((size, size), Image.Resampling.LANCZOS)
        )
        data = io.BytesIO()
        picture.save(data, "WEBP", quality=_QUALITY, method=6)
        found.append((name, data.getvalue()))
    return tuple(found)


def author_pictures(face: Face, pictures: Sequence[tuple[str, bytes]], where: str) -> tuple[str, ...]:
    """Give materials other pictures of colours within `Face.deriving`; a line for each that the face does not have.

    :raises InputError: no picture
    """
    known, warnings = set(face.material_names.values()), []
    for name, data in pictures:
        open_image(data, f"{where} -> {name}", formats=("WEBP",))
        if name in known:
            face.new_texture([name], f"{name}_person.webp", data)
        else:
            warnings.append(f"{where}: left out: a picture of {name}, a material that the face does not have")
    return tuple(warnings)


def _cut(mesh: Mesh | None, drawn: Sequence[str]) -> str | None:
    """The style that cards are, wherever they lie: by where their pictures show them."""
    if mesh is None or not mesh.uv_sets:
        return None
    uv = np.asarray(mesh.uv_sets[0].values)
    return next((name for name in drawn if _same(cards(name).uv, uv)), None)


def _same(one: FloatArray, other: FloatArray) -> bool:
    return one.shape == other.shape and bool(np.abs(one - other).max() < _NEAR)


def _author_material(face: Face, before: Material, material: Material) -> None:
    for field in _FIELDS:
        old, new = getattr(before, field), getattr(material, field)
        if isinstance(old, TextureInput) and isinstance(new, TextureInput):
            if old.texture.image() != new.texture.image():
                path = Path(new.texture.name)
                face.new_texture([before.name], f"{path.stem}_person{path.suffix}", new.texture.image(), field)
            if field == "diffuse_color":
                author_color_scale(_prim(face, before.name), new.scale)


def _prim(face: Face, material: str) -> object:
    path = next(path for path, name in face.material_names.items() if name == material)
    return face.stage.GetPrimAtPath(path)


def _material(parts: FaceParts, name: str) -> Material | None:
    return next((one for one in parts.materials if one.name == name), None)


def _texture(material: Material | None) -> TextureInput | None:
    color = None if material is None else material.diffuse_color
    return color if isinstance(color, TextureInput) else None


def _scale(material: Material | None) -> FloatArray | None:
    own = _texture(material)
    return None if own is None else np.maximum(np.array(own.scale[:3]), 1e-4)


def _is_clear(material: Material) -> bool:
    return material.opacity == 0.0
