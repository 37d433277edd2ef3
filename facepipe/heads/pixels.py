"""Pictures as arrays: sizes, sRGB, image files."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Texture


def enlarged(values: Any, size: int) -> Any:
    """(size, size[, 3]) a picture of another size, bicubic; float32 (h, w), or bytes (h, w, 3)."""
    from PIL import Image

    if values.shape[0] == size:
        return values
    picture = Image.fromarray(values if values.dtype == np.uint8 else values.astype(np.float32))
    return np.array(picture.resize((size, size), Image.Resampling.BICUBIC))


def to_bytes(values: FloatArray) -> Any:
    """0..1 as 0..255."""
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def jpeg(name: str, pixels: Any) -> Texture:
    """An image file of bytes (h, w, 3)."""
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(pixels).save(stream, format="JPEG", quality=90, subsampling=0)
    return Texture(name=f"{name}.jpg", data=stream.getvalue())
