"""Pictures of materials made anew: no larger than asked for, as JPEG, WebP or PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.images import open_image, pixels
from facepipe.parts import FaceParts, Material, Texture, TextureInput
from facepipe_gltf.options import TextureFormat

Pixels = npt.NDArray[np.uint8]
Format = Literal["jpeg", "webp", "png"]
_Made = dict[tuple[bytes, str, bool, bool, float], Texture]

_SUFFIX: Mapping[Format, str] = {"jpeg": ".jpg", "webp": ".webp", "png": ".png"}
_STARTS = {"jpeg": b"\xff\xd8\xff", "webp": b"RIFF", "png": b"\x89PNG"}
COLORS = 256  # of a picture with alpha: a third of the bytes, and hair and whites of eyes have few
_QUALITY = {"jpeg": 85, "webp": 82}
_QUALITY_OF_NORMALS = {"jpeg": 90, "webp": 90}  # errors of these are seen as dents in highlights
_SMALLER = ("roughness", "metallic", "occlusion", "clearcoat", "clearcoat_roughness")  # half as large as colours


def packed_image(picture: Pixels, kind: Format, *, normals: bool = False, colors: int = 0) -> bytes:
    """A file of (h, w, 3 or 4) pixels; JPEG holds no alpha.

    :param colors: of a PNG with alpha at most, 0 for all
    """
    from PIL import Image as Pillow

    image = Pillow.fromarray(picture[..., :3] if kind == "jpeg" else picture)
    settings: dict[str, Any] = {"optimize": True}
    if kind == "png" and picture.shape[2] == 4 and colors:
        image = image.quantize(colors, method=Pillow.Quantize.FASTOCTREE, dither=Pillow.Dither.NONE)
    if kind in _QUALITY:
        settings = {"quality": (_QUALITY_OF_NORMALS if normals else _QUALITY)[kind], "method": 6}
    if kind == "jpeg":
        settings = {"quality": settings["quality"], "optimize": True, "progressive": True}
        settings |= {"subsampling": 0} if normals else {}
    stream = io.BytesIO()
    image.save(stream, format=kind.upper(), **settings)
    return stream.getvalue()


def repacked(parts: FaceParts, kind: TextureFormat | None, size: int | None) -> FaceParts:
    """The face with pictures of at most `size` pixels a side; those with alpha are PNG where `kind` is JPEG.

    What can't be read stays as it is: the writer says so. A file that is small enough and smaller than the new one
    stays too.

    :param kind: "kept" and None: what each is; "ktx2": as it is, or PNG, which the writer compresses
    :param size: None: as large as they are
    """
    made: _Made = {}
    format_: Format | None = None if kind == "ktx2" or kind == "kept" else kind
    materials = tuple(_repacked(material, format_, size or np.inf, made) for material in parts.materials)
    return replace(parts, materials=materials)


def _repacked(material: Material, kind: Format | None, size: float, made: _Made) -> Material:
    opacity = material.opacity
    clear = opacity.texture if isinstance(opacity, TextureInput) else None

    def change(used: TextureInput, *, normals: bool, most: float) -> TextureInput:
        alpha = used.channels == "a" or (clear is not None and used.texture == clear)
        key = (used.texture.data, used.texture.name, alpha, normals, most)
        if key not in made:
            made[key] = _made(used.texture, kind, most, alpha=alpha, normals=normals)
        return replace(used, texture=made[key])

    inputs: Mapping[str, TextureInput] = material.textured
    changed: dict[str, Any] = {
        name: change(used, normals=name == "normal", most=size / 2 if name in _SMALLER else size)
        for name, used in inputs.items()
    }
    wrinkles = material.wrinkles
    if wrinkles is not None:
        plain = partial(change, normals=False, most=size)
        regions = tuple(replace(one, mask=plain(one.mask)) for one in wrinkles.regions)
        normal = change(wrinkles.normal, normals=True, most=size)
        changed["wrinkles"] = replace(wrinkles, normal=normal, tint=plain(wrinkles.tint), regions=regions)
    return replace(material, **changed)


def _made(texture: Texture, kind: Format | None, most: float, *, alpha: bool, normals: bool) -> Texture:
    from PIL import Image as Pillow

    try:
        picture = pixels(open_image(texture.image(), texture.name), "RGBA", texture.name)
    except InputError:
        return texture
    height, width = picture.shape[:2]
    shrunk = most / max(height, width)
    if shrunk >= 1.0 and kind is None:
        return texture
    own: Format = next((one for one in _SUFFIX if texture.data.startswith(_STARTS[one])), "png")
    made_as = kind or own
    made_as = "png" if alpha and made_as == "jpeg" else made_as
    if shrunk < 1.0:
        shape = max(round(width * shrunk), 1), max(round(height * shrunk), 1)
        # channel by channel: Pillow would weigh colours by alpha, and those of clear texels are meant to be seen
        planes = [
            Pillow.fromarray(np.ascontiguousarray(picture[..., channel])).resize(shape, Pillow.Resampling.LANCZOS)
            for channel in range(4)
        ]
        picture = np.stack([np.asarray(plane) for plane in planes], axis=-1)
    colors = COLORS if kind else 0
    data = packed_image(picture if alpha else picture[..., :3], made_as, normals=normals, colors=colors)
    if shrunk >= 1.0 and texture.data.startswith(_STARTS[made_as]) and len(texture.data) <= len(data):
        return texture
    stem = texture.name.rpartition(".")[0] or texture.name
    return Texture(name=f"{stem}{_SUFFIX[made_as]}", data=data)
