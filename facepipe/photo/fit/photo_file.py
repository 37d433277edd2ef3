"""Photos as arrays: upright, in sRGB, and no larger than a fit can use."""

from __future__ import annotations

import io
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import Float32Array
from facepipe.core.errors import InputError
from facepipe.core.images import decoding, open_image
from facepipe.core.reading import read_bytes

if TYPE_CHECKING:
    from PIL.Image import Image

BACKDROP = 0.5  # sRGB, seen through transparent pixels
_GREY = 2 / 255  # a picture whose channels differ by no more than that has no colour
LARGEST = 2048  # pixels a side: a face that fills an eighth of the picture still has 256
SMALLEST = 64  # pixels a side: a smaller picture shows no face worth fitting
_MOST_BYTES = 1 << 28
_ORIENTATION = 0x0112  # the tag in EXIF
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM", "TGA", "HEIF")
_EXPECTED = "a picture (JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF, PPM, TGA or HEIC)"


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


@dataclass(frozen=True, kw_only=True)
class Photo:
    """A photo of a face.

    Places in it count from the top left corner, x right and y down; the first pixel's centre is (0.5, 0.5).
    """

    pixels: Float32Array  # (h, w, 3) sRGB 0..1, upright, top row first
    path: Path  # the file
    size: tuple[int, int]  # width and height of the file's picture, upright
    scale: float = 1.0  # from pixels of the file's picture to these
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name


def read_photo(path: Path, *, largest: int = LARGEST) -> Photo:
    """Read a picture of a common kind; of several in a file the first.

    It is turned upright by its EXIF orientation. Colours go from the embedded profile to sRGB; without a profile they
    are taken as sRGB. Grey becomes three equal channels, CMYK without a profile a guess, 16 bits the nearest 8.
    Transparent pixels are mixed with mid grey (0.5): the colours under them may be anything.

    :param largest: pixels of the longer side; a larger picture is reduced to that
    :raises InputError: not readable, no such picture, damaged, cut short, below 64 pixels a side, or as
        `open_image`
    """
    if largest < SMALLEST:
        raise InputError("option largest", f"is {largest}, expected at least {SMALLEST} pixels")
    notes: list[str] = []
    data = read_bytes(path, _MOST_BYTES)
    if not data:
        raise InputError(path, f"is empty, expected {_EXPECTED}")
    with decoding(path):
        image = open_image(data, path, _FORMATS, expected=_EXPECTED)
        # the further pictures of an MPO are previews and other views of the same
        if image.format != "MPO":
            with suppress(Exception):  # decoders fail in every way; the first picture may be fine
                image.seek(1)  # to count them takes as long as there are many
                notes.append("holds several pictures: the first is read")
        image = open_image(data, path, _FORMATS, expected=_EXPECTED)  # at its first picture
        image.load()
        image = expanded(_upright(image, notes), str(path))
        size = image.size
        reduced, scale = _reduced(image, largest)
        if min(size) < SMALLEST:
            raise InputError(path, f"is {size[0]} x {size[1]} pixels, expected at least {SMALLEST} a side")
        if min(reduced.size) < SMALLEST:
            what = f"is {size[0]} x {size[1]} pixels, {reduced.size[0]} x {reduced.size[1]} when reduced"
            raise InputError(path, f"{what}, expected at least {SMALLEST} a side")
        # (h, w, 3) sRGB 0..1 of a picture that `expanded` gave, over the backdrop where it is transparent
        colors = np.asarray(_rgb(reduced, notes), dtype=np.float32) / np.float32(255)
        if "A" in reduced.mode and reduced.mode != "LAB":
            alpha = np.asarray(reduced.getchannel("A"), dtype=np.float32)[..., None] / np.float32(255)
            if alpha.min() < 1:
                notes.append("has transparent pixels: mixed with mid grey")
                colors = colors * alpha + np.float32(BACKDROP) * (1 - alpha)
        if np.ptp(colors, axis=2).max() <= _GREY:
            notes.append("has no colour: the colours of a fit mean nothing")
        pixels = np.ascontiguousarray(colors, dtype=np.float32)
    if scale < 1:
        notes.append(f"reduced from {size[0]} x {size[1]} to {reduced.width} x {reduced.height} pixels")
    return Photo(pixels=pixels, path=path, size=size, scale=scale, warnings=tuple(notes))


def _upright(image: Image, notes: list[str]) -> Image:
    """The loaded picture as EXIF says it is seen; TIFFs turn when loaded, and have no orientation any more."""
    from PIL.Image import Transpose

    methods = {
        2: Transpose.FLIP_LEFT_RIGHT,
        3: Transpose.ROTATE_180,
        4: Transpose.FLIP_TOP_BOTTOM,
        5: Transpose.TRANSPOSE,
        6: Transpose.ROTATE_270,
        7: Transpose.TRANSVERSE,
        8: Transpose.ROTATE_90,
    }
    try:
        method = methods.get(int(image.getexif().get(_ORIENTATION) or 1))
    except Exception:  # as with pictures: damaged metadata fails in every way, and the picture may be fine
        notes.append("EXIF can't be read: taken as upright")
        method = None
    if method is None:
        return image
    turned = image.transpose(method)
    turned.info = image.info  # profile and transparency
    return turned


def _reduced(image: Image, largest: int) -> tuple[Image, float]:
    """The picture with no side above `largest`, and the factor of both axes.

    The factor is exactly the same for both: less than a row of the result is cut off at the right or at the bottom.
    """
    from PIL.Image import Resampling

    scale = largest / max(image.size)
    if scale >= 1:
        return image, 1.0
    width, height = (largest if side == max(image.size) else max(1, int(side * scale)) for side in image.size)
    box = (0.0, 0.0, min(width / scale, image.width), min(height / scale, image.height))
    reduced = image.resize((width, height), Resampling.LANCZOS, box=box, reducing_gap=3.0)
    reduced.info = image.info
    return reduced, scale
