"""Images, samplers and textures of a glTF document; new images from channels of others."""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.images import open_image
from facepipe.core.images import pixels as decoded
from facepipe.parts import Texture, TextureInput
from facepipe.records import Json

Pixels = npt.NDArray[np.uint8]

_WRAP = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"


@dataclass(frozen=True)
class Image:
    """An image file as it goes into the document."""

    name: str  # without extension
    mime: str
    data: bytes

    @property
    def extension(self) -> str:
        """File name extension with its dot."""
        return ".png" if self.mime == "image/png" else ".jpg"


class Textures:
    """Collects images, each once however often it is used."""

    def __init__(self) -> None:
        self.images: list[Image] = []
        self.samplers: list[Json] = []
        self.textures: list[Json] = []
        self.warnings: list[str] = []
        self._number: dict[bytes, int] = {}

    def whole(self, texture: Texture) -> int | None:
        """The image of a texture: PNG and JPEG as they are, others as PNG; None (and a warning) where unreadable.

        :raises InputError: one that may not be copied
        """
        if self._open(texture, decode=False) is None:
            return None
        if texture.data.startswith(_PNG):
            return self._image(Image(_stem(texture), "image/png", _without_ignored_chunks(texture.data)))
        if texture.data.startswith(_JPEG):
            return self._image(Image(_stem(texture), "image/jpeg", texture.data))
        pixels = self.pixels(texture)
        return None if pixels is None else self.made(_stem(texture), pixels)

    def made(self, name: str, pixels: Pixels) -> int:
        """A PNG of (h, w, 3 or 4) pixels."""
        from PIL import Image as Pillow

        stream = io.BytesIO()
        Pillow.fromarray(pixels).save(stream, format="PNG")
        return self._image(Image(name, "image/png", stream.getvalue()))

    def pixels(self, texture: Texture) -> Pixels | None:
        """(h, w, 4) pixels of a texture; None (and a warning) where unreadable."""
        opened = self._open(texture)
        if opened is None:
            return None
        try:
            return decoded(opened, "RGBA", texture.name)
        except InputError as error:
            self._unreadable(texture, error)
            return None

    def info(self, image: int, source: TextureInput, uv_names: tuple[str, ...]) -> Json:
        """A textureInfo that reads `image` like `source` does."""
        if source.uv_set not in uv_names:
            self.warn(f"{source.texture.name}: reads UV set '{source.uv_set}', which is missing; '{uv_names[0]}' taken")
        sampler = {"wrapS": _WRAP[source.wrap_s], "wrapT": _WRAP[source.wrap_t]}
        texture = {"sampler": _place(self.samplers, sampler), "source": image}
        info: Json = {"index": _place(self.textures, texture)}
        if source.uv_set in uv_names and uv_names.index(source.uv_set):
            info["texCoord"] = uv_names.index(source.uv_set)
        return info

    def warn(self, line: str) -> None:
        """Add a warning, once."""
        if line not in self.warnings:
            self.warnings.append(line)

    def _open(self, texture: Texture, *, decode: bool = True) -> Any | None:
        data = texture.image()
        try:
            return open_image(data, texture.name, decode=decode)
        except InputError as error:
            self._unreadable(texture, error)
            return None

    def _unreadable(self, texture: Texture, error: InputError) -> None:
        self.warn(f"{texture.name}: texture left out, it {error.what}")

    def _image(self, image: Image) -> int:
        digest = hashlib.sha256(image.data).digest()
        if digest not in self._number:
            self._number[digest] = len(self.images)
            self.images.append(image)
        return self._number[digest]


def _place(entries: list[Json], entry: Json) -> int:
    """Index of `entry` in `entries`, added where missing."""
    if entry not in entries:
        entries.append(entry)
    return entries.index(entry)


def _stem(texture: Texture) -> str:
    name = texture.name.replace("\\", "/").rpartition("/")[2]
    return name.rpartition(".")[0] or name or "image"


def _without_ignored_chunks(data: bytes) -> bytes:
    """The same picture without colour profile, chromaticities and pixel aspect ratio.

    glTF defines the colour space of every texture itself. Pixel bytes stay untouched; a file that has none of these
    chunks is returned as it is.
    """
    kept, position = [_PNG], len(_PNG)
    while position + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if not _is_ignored(kind, data[position + 8 : end]):
            kept.append(data[position:end])
        position = end
    return b"".join(kept)


def _is_ignored(kind: bytes, body: bytes) -> bool:
    return kind in (b"cHRM", b"iCCP") or (kind == b"pHYs" and body[:4] != body[4:8])


class Channel(NamedTuple):
    """One channel of a new image: a texture's, or white."""

    source: TextureInput | None = None
    channel: int = 0
    inverted: bool = False


def merged(channels: Sequence[Channel], textures: Textures) -> Pixels | None:
    """(h, w, channels) pixels, as large as the largest texture; None where a texture can't be read."""
    loaded = [None if one.source is None else _plane(textures, one.source, one.channel) for one in channels]
    present = [plane for plane in loaded if plane is not None]
    if len(present) < sum(one.source is not None for one in channels):
        return None
    height, width = max((plane.shape for plane in present), key=lambda size: size[0] * size[1])
    planes = []
    for channel, loaded_plane in zip(channels, loaded, strict=True):
        white = np.full((height, width), 255, np.uint8)
        plane = white if loaded_plane is None else _resized(loaded_plane, height, width)
        planes.append(255 - plane if channel.inverted else plane)
    return np.stack(planes, axis=-1)


def _plane(textures: Textures, source: TextureInput, channel: int) -> Pixels | None:
    pixels = textures.pixels(source.texture)
    return None if pixels is None else pixels[..., channel].copy()  # the others are let go


def _resized(plane: Pixels, height: int, width: int) -> Pixels:
    if plane.shape == (height, width):
        return plane
    from PIL import Image as Pillow

    return np.asarray(Pillow.fromarray(plane).resize((width, height), Pillow.Resampling.BILINEAR))
