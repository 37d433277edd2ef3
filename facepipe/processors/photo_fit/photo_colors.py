"""Pixels of any kind as sRGB."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

BACKDROP = 0.5  # sRGB, seen through transparent pixels
_GREY = 2 / 255  # a picture whose channels differ by no more than that has no colour


def expanded(image: Image, where: str) -> Image:
    """The picture in a mode of 8 bits a channel without palette: L, LA, RGB, RGBA, CMYK, LAB or YCbCr.

    :raises InputError: pixels that are not whole numbers of at most 16 bits
    """
    from PIL import Image as Images

    if image.mode == "F":
        raise InputError(where, "has pixels of floating point, expected whole numbers of 8 or 16 bits")
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 0xFFFF:
            raise InputError(where, "has grey of more than 16 bits, expected 8 or 16")
        result = Images.fromarray(((values.astype(np.uint32) * 255 + 0x7FFF) // 0xFFFF).astype(np.uint8))
    elif "transparency" in image.info or image.mode in ("PA", "RGBa", "La"):
        result = image.convert("LA" if image.mode in ("1", "L", "La") else "RGBA")
    elif image.mode in ("L", "LA", "RGB", "RGBA", "CMYK", "LAB", "YCbCr"):
        return image
    else:
        result = image.convert("L" if image.mode == "1" else "RGB")
    result.info = {key: value for key, value in image.info.items() if key == "icc_profile"}
    return result


def srgb(image: Image, notes: list[str]) -> npt.NDArray[np.float32]:
    """(h, w, 3) sRGB 0..1 of a picture that `expanded` gave, over the backdrop where it is transparent."""
    colors = np.asarray(_rgb(image, notes), dtype=np.float32) / np.float32(255)
    if "A" in image.mode and image.mode != "LAB":
        alpha = np.asarray(image.getchannel("A"), dtype=np.float32)[..., None] / np.float32(255)
        if alpha.min() < 1:
            notes.append("has transparent pixels: mixed with mid grey")
            colors = colors * alpha + np.float32(BACKDROP) * (1 - alpha)
    if np.ptp(colors, axis=2).max() <= _GREY:
        notes.append("has no colour: the colours of a fit mean nothing")
    return np.ascontiguousarray(colors, dtype=np.float32)


def _rgb(image: Image, notes: list[str]) -> Image:
    """The colours through the embedded profile where there is one that can be used."""
    plain = image.convert("RGB") if image.mode == "RGBA" else image.getchannel("L") if image.mode == "LA" else image
    profile = image.info.get("icc_profile")
    if profile or plain.mode == "LAB":
        from PIL import ImageCms

        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile)) if profile else ImageCms.createProfile("LAB")
            target = ImageCms.createProfile("sRGB")
            converted = ImageCms.profileToProfile(plain, source, target, outputMode="RGB")
        except (ImageCms.PyCMSError, OSError, TypeError, ValueError, ImportError) as error:
            notes.append(f"the colour profile can't be used ({' '.join(str(error).split())[:60]}): colours are a guess")
        else:
            assert converted is not None  # not in place
            return converted
    elif plain.mode == "CMYK":
        notes.append("is CMYK without a colour profile: colours are a guess")
    return plain.convert("RGB")
