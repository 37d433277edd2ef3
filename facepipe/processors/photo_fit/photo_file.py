"""Photos as arrays: upright, in sRGB, and no larger than a fit can use."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError
from facepipe.processors.photo_fit.photo_colors import expanded, srgb
from facepipe.reading import read_bytes

if TYPE_CHECKING:
    from PIL.Image import Image

LARGEST = 2048  # pixels a side: a face that fills an eighth of the picture still has 256
SMALLEST = 64  # pixels a side: a smaller picture shows no face worth fitting
MOST_PIXELS = 128_000_000  # a little more than a phone of 108 megapixels makes
_MOST_BYTES = 1 << 28
_ORIENTATION = 0x0112  # the tag in EXIF
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "AVIF", "JPEG2000", "BMP", "GIF", "PPM", "TGA")
_EXPECTED = "a picture (JPEG, PNG, WebP, TIFF, AVIF, JPEG 2000, BMP, GIF, PPM or TGA)"
_HEIC = (b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypmif1")


@dataclass(frozen=True, kw_only=True)
class Photo:
    """A photo of a face.

    Places in it count from the top left corner, x right and y down; the first pixel's centre is (0.5, 0.5).
    """

    pixels: npt.NDArray[np.float32]  # (h, w, 3) sRGB 0..1, upright, top row first
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
    :raises InputError: not readable, no such picture, damaged, cut short, below 64 pixels a side or above 128 million
    """
    if largest < SMALLEST:
        raise InputError("option largest", f"is {largest}, expected at least {SMALLEST} pixels")
    notes: list[str] = []
    data = read_bytes(path, _MOST_BYTES)
    with _decoding(path, data):
        image = expanded(_upright(_opened(path, data, notes), notes), str(path))
        size = image.size
        reduced, scale = _reduced(image, largest)
        _check_size(path, size, reduced.size)
        pixels = srgb(reduced, notes)
    if scale < 1:
        notes.append(f"reduced from {size[0]} x {size[1]} to {reduced.width} x {reduced.height} pixels")
    return Photo(pixels=pixels, path=path, size=size, scale=scale, warnings=tuple(notes))


@contextmanager
def _decoding(path: Path, data: bytes) -> Iterator[None]:
    """Whatever a decoder raises as one line: damaged files make decoders fail in every way."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd metadata; sizes are checked here
            yield
    except InputError:
        raise
    except Image.DecompressionBombError as error:
        raise InputError(path, f"is too large: {error}") from None
    except UnidentifiedImageError:
        found = "is empty" if not data else "is HEIC" if data[4:12] in _HEIC else "is not a picture that can be read"
        raise InputError(path, f"{found}, expected {_EXPECTED}") from None
    except MemoryError:
        raise InputError(path, "is too large for the memory at hand") from None
    except Exception as error:
        raise InputError(path, f"is damaged or cut short: {str(error)[:120] or type(error).__name__}") from None


def _opened(path: Path, data: bytes, notes: list[str]) -> Image:
    from PIL import Image as Images

    Images.init()
    known = [one for one in _FORMATS if one in Images.OPEN]  # an older Pillow has no AVIF
    image: Image = Images.open(io.BytesIO(data), formats=known)
    if image.width * image.height > MOST_PIXELS:
        raise InputError(path, f"is {image.width} x {image.height} pixels, expected at most {MOST_PIXELS:,}")
    # the further pictures of an MPO are previews and other views of the same
    if image.format != "MPO" and getattr(image, "n_frames", 1) > 1:
        notes.append("holds several pictures: the first is read")
    image.load()
    return image


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


def _check_size(path: Path, size: tuple[int, int], reduced: tuple[int, int]) -> None:
    if min(size) < SMALLEST:
        raise InputError(path, f"is {size[0]} x {size[1]} pixels, expected at least {SMALLEST} a side")
    if min(reduced) < SMALLEST:
        what = f"is {size[0]} x {size[1]} pixels, {reduced[0]} x {reduced[1]} when reduced"
        raise InputError(path, f"{what}, expected at least {SMALLEST} a side")
