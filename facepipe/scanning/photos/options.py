"""What may be set about a scan from photos."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.declare import check_ranges, option

FEWEST_PHOTOS = 5


@dataclass(frozen=True, kw_only=True)
class ScanPhotosOptions:
    """How photos become a scan.

    :raises InputError: an option out of range
    """

    pixels: int = option(1600, "longer side that larger photos are shrunk to", 200, 8000, "pixels")
    lens: str = option(
        "shared",
        "cameras that take photos of one size and EXIF focal length have one lens, or each its own",
        choices=("shared", "each"),
    )
    neighbours: int = option(4, "other photos that each photo's depth is found with, at least", 1, 12)
    support: int = option(2, "other photos whose depth must agree for a point to be kept", 1, 8)
    agreement: float = option(
        3.0, "how far depths may be apart that agree, in widths of a pixel on the skin", 0.2, 50.0, "pixels"
    )
    texture: float = option(
        2.0,
        "contrast below which a place of a photo is too plain to be matched; above what noise has",
        0.0,
        50.0,
        "levels of 255",
    )
    spacing: float = option(2.0, "distance of the scan's points, in widths of a pixel on the skin", 0.5, 50.0, "pixels")
    outliers: float = option(
        2.5,
        "points whose distance from their neighbours is above the mean by this many standard deviations go",
        0.5,
        100.0,
    )
    smallest: float = option(0.05, "least share of the points that a loose piece may have", 0.0, 0.9)
    gap: float = option(4.0, "the surface ends this far from the nearest point, in distances of points", 1.0, 100.0)
    radius: float = option(
        250.0,
        "of the ball that the cameras look at, where the scale is unknown: about millimetres of a head",
        1e-6,
        1e6,
    )
    landmarks: bool = option(True, "find the 68 landmarks in the photos, where the extra [train] is installed")
    seed: int = option(0, "seed of the random choices", 0, 2**31 - 1)

    def __post_init__(self) -> None:
        check_ranges(self)
        for name in ("pixels", "neighbours", "support", "seed"):
            if not isinstance(getattr(self, name), int):
                raise InputError(f"option {name}", f"is {getattr(self, name)!r}, expected a whole number")
