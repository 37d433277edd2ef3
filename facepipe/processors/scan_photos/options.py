"""What may be set about a scan from photos."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.errors import InputError
from facepipe.options import check_ranges

FEWEST_PHOTOS = 5


@dataclass(frozen=True, kw_only=True)
class ScanPhotosOptions:
    """How photos become a scan.

    :raises InputError: an option out of range
    """

    pixels: int = field(
        default=1600,
        metadata={"help": "longer side that larger photos are shrunk to", "unit": "pixels", "range": (200, 8000)},
    )
    lens: str = field(
        default="shared",
        metadata={
            "help": "cameras that take photos of one size and EXIF focal length have one lens, or each its own",
            "choices": ("shared", "each"),
        },
    )
    neighbours: int = field(
        default=4, metadata={"help": "other photos that each photo's depth is found with, at least", "range": (1, 12)}
    )
    support: int = field(
        default=2, metadata={"help": "other photos whose depth must agree for a point to be kept", "range": (1, 8)}
    )
    agreement: float = field(
        default=3.0,
        metadata={
            "help": "how far depths may be apart that agree, in widths of a pixel on the skin",
            "unit": "pixels",
            "range": (0.2, 50.0),
        },
    )
    texture: float = field(
        default=2.0,
        metadata={
            "help": "contrast below which a place of a photo is too plain to be matched; above what noise has",
            "unit": "levels of 255",
            "range": (0.0, 50.0),
        },
    )
    spacing: float = field(
        default=2.0,
        metadata={
            "help": "distance of the scan's points, in widths of a pixel on the skin",
            "unit": "pixels",
            "range": (0.5, 50.0),
        },
    )
    outliers: float = field(
        default=2.5,
        metadata={
            "help": "points whose distance from their neighbours is above the mean by this many standard deviations go",
            "range": (0.5, 100.0),
        },
    )
    smallest: float = field(
        default=0.05, metadata={"help": "least share of the points that a loose piece may have", "range": (0.0, 0.9)}
    )
    gap: float = field(
        default=4.0,
        metadata={
            "help": "the surface ends this far from the nearest point, in distances of points",
            "range": (1.0, 100.0),
        },
    )
    radius: float = field(
        default=250.0,
        metadata={
            "help": "of the ball that the cameras look at, where nothing tells the scale: about millimetres of a head",
            "range": (1e-6, 1e6),
        },
    )
    landmarks: bool = field(
        default=True, metadata={"help": "find the 68 landmarks in the photos, where the extra [train] is installed"}
    )
    seed: int = field(default=0, metadata={"help": "seed of the random choices", "range": (0, 2**31 - 1)})

    def __post_init__(self) -> None:
        check_ranges(self)
        for name in ("pixels", "neighbours", "support", "seed"):
            if not isinstance(getattr(self, name), int):
                raise InputError(f"option {name}", f"is {getattr(self, name)!r}, expected a whole number")
