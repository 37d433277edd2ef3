"""Region maps: PNG images as their raw 8-bit values."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.reading import read_bytes

MOST_BYTES = 1 << 28
_BROKEN = (OSError, ValueError, SyntaxError, EOFError, OverflowError)


def read_region_image(path: Path) -> npt.NDArray[np.uint8]:
    """(h, w, 3|4) pixels of a PNG of any kind, top row first; palettes and greys as colours, 16 bits as their upper 8.

    Values are taken as they are: colour profiles and gamma do not count.

    :raises InputError: no PNG that can be read, or one too large
    """
    from PIL import Image, UnidentifiedImageError

    data = read_bytes(path, MOST_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd metadata
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
                return _pixels(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(path, f"is too large: {error}") from None
    except _BROKEN as error:
        reason = "no PNG" if isinstance(error, UnidentifiedImageError) else error
        raise InputError(path, f"can't be read as a PNG: {reason}") from None


def _pixels(image: object) -> npt.NDArray[np.uint8]:
    from PIL import Image

    assert isinstance(image, Image.Image)
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip
        grey = (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    clear = "A" in image.getbands() or "transparency" in image.info
    return np.array(image.convert("RGBA" if clear else "RGB"))
