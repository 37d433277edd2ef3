"""Options of registration, of split composites and of sampled maps; without numpy, since actions declare them."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.declare import Ranged, option

LARGEST_RGB_DISTANCE = 442.0  # from black to white: every colour is within it
WIDEST_EDGE, WIDEST_FOOTPRINT = 8, 256  # texels
FIRST_TILE, LAST_TILE = 1001, 1999  # UDIM: 1001 + column + 10 row, ten columns


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """Expected errors and weights of a registration's terms."""

    surface_sigma_mm: float = 0.3  # of the distances from the scan; matches count by area over its square
    huber_mm: float = 0.3  # distances beyond count linearly
    reach_mm: float = 4.0  # matches further off are dropped, in the last stage
    angle: float = 0.84  # radians between normals, beyond which a match is dropped
    anchor_sigma_mm: float = 0.16  # of landmarks and markers
    membrane: float = 6.0  # stiffness of the residual
    scale: bool = True  # the scan's size is not known


@dataclass(frozen=True, kw_only=True)
class SplitOptions(Ranged):
    """Limits of how far shapes leave their templates, and the expected errors of scans and weights.

    Spreads are standard deviations of what people and scans are expected to do. Lengths are in the unit of the points,
    millimetres: a face scaled needs them scaled alike.

    :raises InputError: a number out of range
    """

    shared_gain: float = option(
        0.2, "spread of how much more or less than their templates all shapes move together", 0.0, 100.0
    )
    own_gain: float = option(0.2, "spread of how much more or less each shape moves by itself", 0.0, 100.0)
    shared_turn: float = option(0.15, "spread of the angle by which all shapes are turned together", 0.0, 100.0, "rad")
    own_turn: float = option(0.15, "spread of the angle by which each shape is turned by itself", 0.0, 100.0, "rad")
    field_length: float = option(
        25.0, "distance over which gains and turns vary: about half of a muscle's length", 1e-6, 1e6, "mm"
    )
    detail: float = option(
        0.2,
        "spread of the detail beyond gains and turns, as a share of the template's motion; larger values follow "
        "the scans more closely, and their errors too",
        0.0,
        1e6,
    )
    detail_length: float = option(
        15.0, "distance over which detail varies, and over which points hold gradients in place", 1e-6, 1e6, "mm"
    )
    noise: float = option(0.1, "expected error of the composites' points, in each coordinate", 1e-9, 1e6, "mm")
    noise_length: float = option(
        15.0, "distance over which that error varies: points closer together share it", 1e-6, 1e6, "mm"
    )
    weight_spread: float = option(
        0.1, "expected error of the given weights; 0 keeps them. Weights of 0 always stay 0", 0.0, 10.0
    )
    largest_weight: float = option(1.2, "fitted weights stay between 0 and this, or the given one", 0.0, 100.0)
    alternations: int = option(3, "rounds of solving for shapes and weights", 1, 100)


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
