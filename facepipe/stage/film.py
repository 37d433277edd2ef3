"""Pinhole cameras in pixels as the lengths of UsdGeom.Camera, and back."""

from __future__ import annotations

import math
from typing import NamedTuple

_FILM = 0.036  # metres of the longer side: that of a 35 mm camera
_TENTHS = 10.0  # UsdGeom.Camera has focal length and apertures in tenths of a stage unit


class Film(NamedTuple):
    """Values of UsdGeom.Camera, in tenths of a stage unit."""

    focal_length: float
    horizontal_aperture: float
    vertical_aperture: float
    horizontal_offset: float
    vertical_offset: float


def to_film(width: int, height: int, focal: float, center: tuple[float, float], meters_per_unit: float) -> Film:
    """The film of a pinhole camera in pixels, y down.

    A pixel is a power of two of them, so that float32 holds its multiples as exactly as it holds pixels; the longer
    side comes to 25 to 51 mm.
    """
    pixel = 2.0 ** round(math.log2(_FILM / meters_per_unit * _TENTHS / max(width, height)))
    return Film(
        focal * pixel, width * pixel, height * pixel, (width / 2 - center[0]) * pixel, (center[1] - height / 2) * pixel
    )


def from_film(film: Film, width: int, height: int) -> tuple[float, tuple[float, float]]:
    """Focal length and principal point in pixels, y down, of a film that `width` by `height` pixels cover.

    Pixels are as wide as high, as the width says.
    """
    across, up = film.horizontal_aperture / width, film.vertical_aperture / height
    center = (width / 2 - film.horizontal_offset / across, height / 2 + film.vertical_offset / up)
    return film.focal_length / across, center
