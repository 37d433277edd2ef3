"""How a face is skinned."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.declare import Ranged, option


@dataclass(frozen=True, kw_only=True)
class SkinOptions(Ranged):
    """Weights of points.

    :raises InputError: a number out of range
    """

    influences: int = option(4, "most joints that move a point", 1, 64)
    sharpness: float = option(
        1.0,
        "how far joints of --joints keep to their own: at 4, weights fall off about twice as fast as at 1",
        0.01,
        100.0,
    )
    smoothing: float = option(2.0, "weights of --from are smoothed over this length along the surface", 0.0, 50.0, "mm")
    count: int = option(60, "joints of --learn-from", 1, 255, before=60)
    iterations: int = option(10, "rounds of --optimise", 1, 1000)
    evenness: float = option(
        0.3, "how much --optimise keeps weights even from point to point: more is smoother and misses more", 0.0, 100.0
    )
