"""Materials of our own glTF files: as recorded, where the file has their images."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from facepipe.parts import Material, Texture, TextureInput
from facepipe_gltf.read.document import Document


def with_images(document: Document, own: Sequence[Material], read: Sequence[Material]) -> tuple[Material, ...]:
    """Recorded materials with images of the file; one whose images are not in it is as it was read."""
    images = {hashlib.sha256(one.texture.data).digest(): one.texture for one in _inputs(read)}
    by_name = {one.name: one for one in read}
    result = []
    for material in own:
        missing = [one for one in _inputs([material]) if one.texture.data not in images]
        if not missing:
            result.append(_with_images(material, images))
            continue
        document.warn("facepipe", f"the images of the material {material.name} were merged: it is read as glTF has it")
        result.append(replace(by_name.get(material.name, Material(name=material.name)), name=material.name))
    return tuple(result)


def _inputs(materials: Sequence[Material]) -> list[TextureInput]:
    values = [getattr(one, field.name) for one in materials for field in fields(one)]
    return [value for value in values if isinstance(value, TextureInput)]


def _with_images(material: Material, images: Mapping[bytes, Texture]) -> Material:
    values = {one.name: getattr(material, one.name) for one in fields(material)}
    whole: dict[str, Any] = {
        name: replace(value, texture=replace(value.texture, data=images[value.texture.data].data))
        for name, value in values.items()
        if isinstance(value, TextureInput)
    }
    return replace(material, **whole)
