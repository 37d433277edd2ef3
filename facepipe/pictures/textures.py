"""Texture lookups: images as linear arrays, sampled bilinearly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.images import open_image, pixels
from facepipe.parts import Texture, TextureInput

Pixels = npt.NDArray[np.float32]

CHANNELS = {"rgb": slice(0, 3), "r": slice(0, 1), "g": slice(1, 2), "b": slice(2, 3), "a": slice(3, 4)}


def srgb_to_linear(values: FloatArray) -> FloatArray:
    """IEC 61966-2-1 decoding of values in 0..1."""
    low = values <= 0.04045
    return np.where(low, values / 12.92, ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values: FloatArray) -> FloatArray:
    """IEC 61966-2-1 encoding; values are clipped to 0..1."""
    clipped = np.clip(values, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * np.maximum(clipped, 0.0031308) ** (1 / 2.4) - 0.055)


def decode(texture: Texture, largest: int) -> npt.NDArray[np.uint8]:
    """(h, w, 4) pixels of a texture, top row first, halved until no side is above `largest`.

    :raises InputError: the bytes are not an image that can be read
    """
    where = f"texture {texture.name}"
    image = open_image(texture.image(), where)
    return pixels(image, "RGBA", where, max(1, max(image.size) // max(largest, 1)))


class TextureCache:
    """Decoded textures of one picture, each decoded once per colour space."""

    def __init__(self, largest: int) -> None:
        """:param largest: pixels a side beyond which a texture holds more than the picture can show."""
        self._pixels = lru_cache(maxsize=None)(lambda texture: decode(texture, largest))
        self._linear = lru_cache(maxsize=None)(self._channels)

    def sample(
        self, source: TextureInput, uv: FloatArray, footprint: FloatArray, *, color: bool = True
    ) -> tuple[Pixels, Pixels]:
        """Values (m, 3) or (m, 1) at UVs (m, 2), ``texel[channels] * scale + bias``; texels that a pixel spans (m,).

        :param footprint: (m,) length in UV space that a pixel of the picture spans
        :param color: the texture holds sRGB colours where three channels are asked for, which become linear
        """
        levels = self._linear(source.texture, source.channels, color)
        texels = (footprint * max(levels[0].shape[:2])).astype(np.float32)
        chosen = np.clip(np.round(np.log2(np.maximum(texels, 1e-6))), 0, len(levels) - 1).astype(np.int64)
        found = np.empty((len(uv), levels[0].shape[2]), np.float32)
        for number in np.flatnonzero(np.bincount(chosen, minlength=1)):
            at = np.flatnonzero(chosen == number)
            found[at] = bilinear(levels[number], uv[at], source.wrap_s, source.wrap_t)
        part = CHANNELS[source.channels]
        found = found * np.array(source.scale[part], np.float32) + np.array(source.bias[part], np.float32)
        return found, texels

    def _channels(self, texture: Texture, channels: str, color: bool) -> list[Pixels]:
        """Linear values, whole and halved again and again."""
        values = self._pixels(texture)[..., CHANNELS[channels]]
        steps = np.arange(256) / 255.0
        table = srgb_to_linear(steps) if channels == "rgb" and color else steps
        levels = [np.asarray(table.astype(np.float32)[values])]
        while min(levels[-1].shape[:2]) > 1:
            height, width = (side // 2 * 2 for side in levels[-1].shape[:2])
            even = levels[-1][:height, :width]
            quarters = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
            levels.append(np.asarray(quarters / 4, np.float32))
        return levels


def bilinear(pixels: Pixels, uv: FloatArray, wrap_s: str = "repeat", wrap_t: str = "repeat") -> Pixels:
    """(m, c) values of pixels (h, w, c), top row first, at UVs (m, 2) with v up."""
    height, width = pixels.shape[:2]
    x = uv[:, 0] * width - 0.5
    y = (1.0 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
    left, right = _wrap(x0, width, wrap_s), _wrap(x0 + 1, width, wrap_s)
    above, below = _wrap(y0, height, wrap_t), _wrap(y0 + 1, height, wrap_t)
    upper = pixels[above, left] * (1 - fx) + pixels[above, right] * fx
    lower = pixels[below, left] * (1 - fx) + pixels[below, right] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def _wrap(index: npt.NDArray[np.int64], size: int, mode: str) -> npt.NDArray[np.int64]:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return np.asarray(index % size)
