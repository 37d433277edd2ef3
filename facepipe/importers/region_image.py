"""Region maps: PNG images as their raw 8-bit values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.core.images import decoding, open_image, pixels
from facepipe.core.reading import read_bytes

MOST_BYTES = 1 << 28


def read_region_image(path: Path) -> npt.NDArray[np.uint8]:
    """(h, w, 3|4) pixels of a PNG of any kind, top row first; palettes and greys as colours, 16 bits as their upper 8.

    Values are taken as they are: colour profiles and gamma are ignored.

    :raises InputError: no PNG that can be read, or one too large
    """
    image = open_image(read_bytes(path, MOST_BYTES), path, ["PNG"], expected="a PNG")
    with decoding(path):
        image.load()
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip
        grey = (np.asarray(image) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    clear = "A" in image.getbands() or "transparency" in image.info
    return pixels(image, "RGBA" if clear else "RGB", path)
