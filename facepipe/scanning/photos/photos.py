"""The photos of a folder, upright, at the resolution that is used."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, ByteArray
from facepipe.core.errors import InputError
from facepipe.core.images import PHOTO_SUFFIXES, decoding, open_image
from facepipe.core.reading import file_beside, files_in, read_bytes
from facepipe.scanning.photos.options import FEWEST_PHOTOS

if TYPE_CHECKING:
    from PIL.Image import Image

_EXIF, _FOCAL_35 = 0x8769, 0xA405  # the IFD of the camera's settings; focal length as on 36 x 24 mm film
_FILM = 36.0  # mm
_FOCALS = (4.0, 2000.0)  # mm: what lenses have
_MOST_BYTES = 1 << 28
_SMALLEST = 64  # pixels a side


@dataclass(frozen=True, kw_only=True)
class Photo:
    """One photo as it is used."""

    name: str  # of its file
    pixels: ByteArray  # (h, w, 3) sRGB, upright
    full_size: tuple[int, int]  # width and height of the file's picture, upright
    focal: float | None = None  # pixels of `pixels`, from EXIF
    mask: BoolArray | None = None  # (h, w) what shows the person

    @property
    def width(self) -> int:
        """Pixels across, as used."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Pixels down, as used."""
        return int(self.pixels.shape[0])


def photo_files(folder: Path) -> tuple[list[Path], list[str]]:
    """Files that are photos by their suffix, by name; and the names of other files, but for hidden ones.

    :raises InputError: no folder, or fewer than 5 photos in it
    """
    if not folder.is_dir():
        raise InputError(folder, "is no folder, expected a folder of photos")
    files = files_in(folder)
    photos = [one for one in files if one.suffix.lower() in PHOTO_SUFFIXES]
    if len(photos) < FEWEST_PHOTOS:
        found = f"{len(photos)} photos ({' '.join(PHOTO_SUFFIXES)})"
        raise InputError(folder, f"{found}, expected {FEWEST_PHOTOS} or more")
    return photos, [one.name for one in files if one not in photos]


def read_photos(files: list[Path], most: int, masks: Path | None = None) -> list[Photo]:
    """The photos, none of them with a side above `most` pixels.

    :param masks: a folder with an image for each photo, white where the person is: ``NAME.png`` for ``NAME.jpg``
    :raises InputError: a file that is no image or too small, a mask that is missing or of another size
    """
    if masks is not None and not masks.is_dir():
        raise InputError(masks, "is no folder, expected a folder of masks")
    photos = []
    for file in files:
        image, film = _image(file)
        full = image.size
        if min(full) < _SMALLEST:
            raise InputError(file, f"{full[0]} x {full[1]} pixels, expected at least {_SMALLEST} a side")
        size = fitting(full, most)
        small = image if size == full else image.resize(size, resample=5, reducing_gap=3.0)  # 5: area average
        photos.append(
            Photo(
                name=file.name,
                pixels=np.array(small, dtype=np.uint8),
                full_size=full,
                focal=None if film is None else film / _FILM * max(size),
                mask=None if masks is None else _mask(file, masks, full, size),
            )
        )
    return photos


def fitting(size: tuple[int, int], most: int) -> tuple[int, int]:
    """Width and height, shrunk to have no side above `most` pixels."""
    shrink = min(1.0, most / max(size))
    return max(1, round(size[0] * shrink)), max(1, round(size[1] * shrink))


def _image(file: Path) -> tuple[Image, float | None]:
    """The picture, upright, in RGB of 8 bits, and its focal length on 36 mm film where EXIF has it."""
    from PIL import Image, ImageOps

    image, film = open_image(read_bytes(file, _MOST_BYTES), file), 0.0
    with decoding(file):
        # settings that can't be read are no reason to refuse a picture
        with contextlib.suppress(TypeError, ValueError, ZeroDivisionError, OSError, SyntaxError):
            film = float(image.getexif().get_ifd(_EXIF).get(_FOCAL_35, 0))
        image = ImageOps.exif_transpose(image)
        if image.mode.startswith("I"):  # grey ones of 16 bits are not cut off at 255
            values = np.asarray(image).clip(0, 0xFFFF).astype(np.uint32)
            image = Image.fromarray(((values * 2 + 257) // 514).astype(np.uint8))
        known = math.isfinite(film) and _FOCALS[0] <= film <= _FOCALS[1]
        return image.convert("RGB"), film if known else None


def _mask(file: Path, masks: Path, full: tuple[int, int], size: tuple[int, int]) -> BoolArray:
    mask_file = file_beside(masks, file.name, f"{file.stem}.png", f"{file.name}.png")
    if mask_file is None:
        raise InputError(masks / f"{file.stem}.png", f"is missing, expected a mask for {file.name}")
    image, _ = _image(mask_file)
    if image.size != full:
        raise InputError(
            mask_file, f"{image.size[0]} x {image.size[1]} pixels, expected the photo's {full[0]} x {full[1]}"
        )
    mask = np.asarray(image.convert("L").resize(size, resample=0)) > 127
    if not mask.any():
        raise InputError(mask_file, "is black all over, expected white where the person is")
    return np.asarray(mask)
