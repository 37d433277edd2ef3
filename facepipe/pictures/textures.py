"""Texture lookups: images as linear arrays, sampled bilinearly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import AnyArray, ByteArray, Float32Array, FloatArray
from facepipe.core.images import open_image, pixels
from facepipe.geometry.colors import from_srgb
from facepipe.parts import Texture, TextureInput

CHANNELS = {"rgb": slice(0, 3), "r": slice(0, 1), "g": slice(1, 2), "b": slice(2, 3), "a": slice(3, 4)}


_DATA: Float32Array = (np.arange(256) / 255.0).astype(np.float32)
_SRGB: Float32Array = from_srgb(_DATA.astype(np.float64)).astype(np.float32)


def decode(texture: Texture, largest: int) -> ByteArray:
    """(h, w, 4) pixels of a texture, top row first, halved until no side is above `largest`.

    :raises InputError: the bytes are not an image that can be read
    """
    where = f"texture {texture.name}"
    image = open_image(texture.image(), where)
    image.draft(None, (largest, largest))  # a JPEG is decoded at a half or less where that is enough
    return pixels(image, "RGBA", where, max(1, max(image.size) // max(largest, 1)))


class TextureCache:
    """Decoded textures, whole and halved again and again, each decoded once."""

    def __init__(self, largest: int) -> None:
        """:param largest: pixels a side beyond which a texture holds more than the picture can show."""
        self.levels = lru_cache(maxsize=None)(lambda texture: _halved(decode(texture, largest)))

    def sample(
        self, source: TextureInput, uv: FloatArray, footprint: FloatArray, *, color: bool = True
    ) -> tuple[Float32Array, Float32Array]:
        """Values (m, 3) or (m, 1) at UVs (m, 2), ``texel[channels] * scale + bias``; texels that a pixel spans (m,).

        :param footprint: (m,) length in UV space that a pixel of the picture spans
        :param color: the texture holds sRGB colours where three channels are asked for, which become linear
        """
        levels, part = self.levels(source.texture), CHANNELS[source.channels]
        # UsdPreviewSurface's automatic colour space: 8-bit RGB is sRGB, single channels are data.
        table = _SRGB if source.channels == "rgb" and color else _DATA
        texels = (footprint * max(levels[0].shape[:2])).astype(np.float32)
        chosen = np.clip(np.round(np.log2(np.maximum(texels, 1e-6))), 0, len(levels) - 1).astype(np.int64)
        values = np.empty((len(uv), part.stop - part.start), np.float32)
        for number in np.flatnonzero(np.bincount(chosen)):
            at = np.flatnonzero(chosen == number)
            values[at] = bilinear(levels[number][..., part], uv[at], source.wrap_s, source.wrap_t, table)
        values = values * np.array(source.scale[part], np.float32) + np.array(source.bias[part], np.float32)
        return values, texels


def _halved(pixels: ByteArray) -> list[ByteArray]:
    """An image (h, w, 4) and ever smaller ones, down to one pixel a side."""
    from PIL import Image

    levels, image = [pixels], Image.fromarray(pixels)
    while min(image.size) > 1:
        image = image.reduce(2)
        levels.append(np.asarray(image))
    return levels


def bilinear(
    pixels: AnyArray,
    uv: FloatArray,
    wrap_s: str = "repeat",
    wrap_t: str = "repeat",
    table: Float32Array | None = None,
) -> Float32Array:
    """(m, c) values of pixels (h, w, c), top row first, at UVs (m, 2) with v up.

    :param table: what 8-bit pixels stand for; None: themselves
    """
    height, width = pixels.shape[:2]
    x = uv[:, 0] * width - 0.5
    y = (1.0 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
    left, right = _wrap(x0, width, wrap_s), _wrap(x0 + 1, width, wrap_s)
    above, below = _wrap(y0, height, wrap_t), _wrap(y0 + 1, height, wrap_t)
    corners = (pixels[row, column] for row in (above, below) for column in (left, right))
    nw, ne, sw, se = corners if table is None else (table[corner] for corner in corners)
    upper, lower = nw * (1 - fx) + ne * fx, sw * (1 - fx) + se * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def _wrap(index: npt.NDArray[np.int64], size: int, mode: str) -> npt.NDArray[np.int64]:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return np.asarray(index % size)
