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
    """(h, w, channels) pixels, as large as the first texture; None where a texture can't be read."""
    first = next(one.source for one in channels if one.source is not None)
    reference = textures.pixels(first.texture)
    if reference is None:
        return None
    height, width = reference.shape[:2]
    planes = []
    for one in channels:
        if one.source is None:
            planes.append(np.full((height, width), 255, np.uint8))
            continue
        pixels = textures.pixels(one.source.texture)
        if pixels is None:
            return None
        plane = _resized(pixels[..., one.channel], height, width)
        planes.append(255 - plane if one.inverted else plane)
    return np.stack(planes, axis=-1)


def _resized(plane: Pixels, height: int, width: int) -> Pixels:
    if plane.shape == (height, width):
        return plane
    from PIL import Image as Pillow

    return np.asarray(Pillow.fromarray(plane).resize((width, height), Pillow.Resampling.BILINEAR))
