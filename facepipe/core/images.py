"""Pictures from elsewhere, decoded by Pillow; their headers are checked before a pixel is decoded."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes

if TYPE_CHECKING:
    from PIL.Image import Image

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
PICTURE_SUFFIXES = (*PHOTO_SUFFIXES, ".heic", ".heif", ".avif", ".jp2", ".gif", ".ppm", ".tga")
MOST_PIXELS = 128_000_000  # a little more than a phone of 108 megapixels makes
FREE_PIXELS, PER_BYTE = 1 << 24, 16  # of any file: 4096 x 4096; and for each of its bytes
_MOST_PARTS = 1000  # chunks of a PNG beside those of its pixels, segments of a JPEG, its scans: each costs time
_MOST_PNG = 1 << 28  # bytes of a picture that is read as it is
_BAND = 1 << 20  # pixels converted at once
_HEIC = (b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypheim", b"ftypheis", b"ftypmif1")
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_STARTS = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"BM", b"RIFF", b"II*\x00", b"MM\x00*", b"v/1\x01", b"#?RADIANCE")


def is_image(data: bytes) -> bool:
    """Whether bytes begin as an image does. Only images are copied or exported, whatever file a stage names."""
    return data.startswith(_STARTS)


def damage_of(data: bytes) -> str | None:
    """What a look at the parts of a PNG or JPEG finds wrong, without decoding it; None for other pictures.

    A PNG ends with its last chunk, and those that make its pixels have their checksums; a JPEG has an end.
    """
    if data.startswith(_JPEG):
        return None if data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda") >= 0 else "is cut short"
    at, kind = len(_PNG), b""
    while data.startswith(_PNG) and kind != b"IEND":
        if at + 12 > len(data):
            return "is cut short"
        size, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + size
        # readers skip the others: their names begin with a small letter (PNG specification, section 5.4)
        if kind[:1].isupper() and data[end : end + 4] != struct.pack(">I", zlib.crc32(memoryview(data)[at + 4 : end])):
            return "is cut short" if end + 4 > len(data) else "is damaged: a checksum is wrong"
        at = end + 4
    return None


def open_image(
    data: bytes,
    where: object,
    formats: Sequence[str] | None = None,
    *,
    expected: str = "a picture",
    decode: bool = True,
) -> Image:
    """The first picture of a file, its header read.

    :param formats: Pillow's names of those that may be; default all
    :param expected: what they are called
    :param decode: pixels are wanted: they must not be too many
    :raises InputError: no such picture, or one of more than 128 million pixels, of more than 16 for each byte of the
        file beyond 16 million, or of too many parts
    """
    from PIL import Image as Pillow

    with decoding(where, expected):
        at, parts, what = len(_PNG), 0, "chunks"
        if data.startswith(_PNG):
            while at + 8 <= len(data) and parts <= _MOST_PARTS:
                size, kind = struct.unpack_from(">I4s", data, at)
                parts += kind not in (b"IDAT", b"fdAT")  # those of its pixels are as many as it is large
                at += 12 + size
        elif data.startswith(_JPEG):
            at, what = 2, "segments"
            while at + 4 <= len(data) and parts <= _MOST_PARTS:
                marker, size = struct.unpack_from(">2H", data, at)
                if marker == 0xFFDA or marker < 0xFF00:
                    break
                parts += 1
                at += 2 + size
        if parts > _MOST_PARTS:
            raise InputError(where, f"more than {_MOST_PARTS} {what}")
        if data.startswith(_JPEG) and data.count(b"\xff\xda") > _MOST_PARTS // 10:
            raise InputError(where, f"more than {_MOST_PARTS // 10} scans")
        if data[4:12] in _HEIC:
            if formats is None or "HEIF" not in formats:
                raise InputError(where, f"is HEIC, expected {expected}")
            import pi_heif

            pi_heif.register_heif_opener()
        (Pillow.preinit if data.startswith((_PNG, _JPEG)) else Pillow.init)()  # all other readers take 0.03 s to load
        known = None if formats is None else [one for one in formats if one in Pillow.OPEN]
        image: Image = Pillow.open(io.BytesIO(data), formats=known)
    most = min(FREE_PIXELS + PER_BYTE * len(data), MOST_PIXELS)
    if decode and image.width * image.height > most:
        fault = f"{image.width} x {image.height} pixels in {len(data)} bytes, expected at most {most} pixels"
        raise InputError(where, fault)
    return image


@contextmanager
def decoding(where: object, expected: str = "a picture") -> Iterator[None]:
    """Whatever a decoder raises becomes one line: damaged pictures make decoders fail in every way.

    :raises InputError: a picture that can't be read
    """
    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd metadata; sizes are checked here
            yield
    except InputError:
        raise
    except Pillow.DecompressionBombError as error:
        raise InputError(where, f"is too large: {error}") from None
    except UnidentifiedImageError:
        raise InputError(where, f"is not a picture that can be read, expected {expected}") from None
    except MemoryError:
        raise InputError(where, "is too large for the memory at hand") from None
    except Exception as error:
        what = str(error)[:120] or type(error).__name__
        raise InputError(where, f"is damaged or cut short: {what}") from None


def pixels(image: Image, mode: str, where: object, factor: int = 1) -> npt.NDArray[np.uint8]:
    """(h, w, channels) of a picture in another mode, squares of `factor` pixels as their mean; 16 bits as the upper 8.

    In bands of rows: no copy of all pixels is made beside the result.

    :raises InputError: damaged or cut short
    """
    from PIL import Image as Pillow

    width, height = (-(-side // factor) for side in image.size)
    rows = max(_BAND // image.width // factor, 1)
    result = np.empty((height, width, len(mode)), np.uint8)
    with decoding(where):
        for first in range(0, height, rows):
            box = (0, first * factor, image.width, min((first + rows) * factor, image.height))
            band = image.crop(box)
            if band.mode.startswith("I"):  # 16-bit grey, which Pillow would clip
                band = Pillow.fromarray((np.asarray(band) >> 8).clip(0, 255).astype(np.uint8))
            band = band.convert(mode)
            result[first : first + rows] = np.asarray(band.reduce(factor) if factor > 1 else band)
    return result


def read_png(path: Path) -> npt.NDArray[np.uint8]:
    """(h, w, 3|4) pixels of a PNG of any kind, top row first; palettes and greys as colours, 16 bits as their upper 8.

    Values are taken as they are: colour profiles and gamma are ignored.

    :raises InputError: no PNG that can be read, or one too large
    """
    image = open_image(read_bytes(path, _MOST_PNG), path, ["PNG"], expected="a PNG")
    with decoding(path):
        image.load()
    clear = "A" in image.getbands() or "transparency" in image.info
    return pixels(image, "RGBA" if clear else "RGB", path)
