"""Textures of a few pixels."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

from facepipe.parts import Texture, TextureInput

RNG = np.random.default_rng(0)
COLORS = RNG.integers(0, 256, (8, 8, 3), np.uint8)


def picture(name: str, pixels: np.ndarray, kind: str = "PNG") -> Texture:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format=kind)
    return Texture(name=name, data=stream.getvalue())


def textured(texture: Texture, channels: Any = "rgb", **options: Any) -> TextureInput:
    return TextureInput(texture=texture, channels=channels, **options)
