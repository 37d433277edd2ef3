"""How a painted map is sampled."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.declare import Ranged, option

LARGEST_RGB_DISTANCE = 442.0  # from black to white: every colour is within it
WIDEST_EDGE, WIDEST_FOOTPRINT = 8, 256  # texels
FIRST_TILE, LAST_TILE = 1001, 1999  # UDIM: 1001 + column + 10 row, ten columns


def tile_number(text: str) -> int | None:
    """A UDIM tile, or None for ``all``.

    :raises InputError: neither
    """
    if text == "all":
        return None
    if not (text.isascii() and text.isdigit()):
        raise InputError("tile", f"'{text[:20]}', expected a UDIM number like {FIRST_TILE}, or all")
    return int(text)


@dataclass(frozen=True, kw_only=True)
class MapSampling(Ranged):
    """How a map is sampled.

    :raises InputError: an option out of range
    """

    tolerance: float = option(
        8.0,
        "distance to a legend colour that still is that colour",
        0,
        LARGEST_RGB_DISTANCE,
        unit="RGB, 0 to 255 a channel",
    )
    edge: int = option(2, "how far antialiased borders run, and paint counts beyond its end", 0, WIDEST_EDGE, "texels")
    footprint: int = option(1, "side of the square averaged at a point; 1: its texel", 1, WIDEST_FOOTPRINT, "texels")
    tile: int | None = option(
        FIRST_TILE,
        "UDIM tile that the map covers, or `all`: it repeats in every tile",
        FIRST_TILE,
        LAST_TILE,
        parse=tile_number,
    )
