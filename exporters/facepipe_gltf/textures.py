"""Images, samplers and textures of a glTF document."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.images import open_image
from facepipe.images import pixels as decoded
from facepipe.parts import Texture, TextureInput
from facepipe_gltf.png import without_ignored_chunks

Json = dict[str, Any]
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
            return self._image(Image(_stem(texture), "image/png", without_ignored_chunks(texture.data)))
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
