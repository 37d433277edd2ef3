"""New images from channels of others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.parts import TextureInput
from facepipe_gltf.textures import Textures

Pixels = npt.NDArray[np.uint8]


class Channel(NamedTuple):
    """One channel of a new image: a texture's, or white."""

    source: TextureInput | None
    channel: int
    inverted: bool = False


def merged(channels: Sequence[Channel], textures: Textures) -> Pixels | None:
    """(h, w, channels) pixels, as large as the largest texture; None where a texture can't be read."""
    loaded = [None if one.source is None else _plane(textures, one.source, one.channel) for one in channels]
    present = [plane for plane in loaded if plane is not None]
    if len(present) < sum(one.source is not None for one in channels):
        return None
    height, width = max((plane.shape for plane in present), key=lambda size: size[0] * size[1])
    planes = []
    for one, found in zip(channels, loaded, strict=True):
        white = np.full((height, width), 255, np.uint8)
        plane = white if found is None else _resized(found, height, width)
        planes.append(255 - plane if one.inverted else plane)
    return np.stack(planes, axis=-1)


def _plane(textures: Textures, source: TextureInput, channel: int) -> Pixels | None:
    pixels = textures.pixels(source.texture)
    return None if pixels is None else pixels[..., channel].copy()  # the others are let go


def _resized(plane: Pixels, height: int, width: int) -> Pixels:
    if plane.shape == (height, width):
        return plane
    from PIL import Image as Pillow

    return np.asarray(Pillow.fromarray(plane).resize((width, height), Pillow.Resampling.BILINEAR))
