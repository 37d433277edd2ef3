"""How a face is skinned."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.options import check_ranges


@dataclass(frozen=True, kw_only=True)
class SkinOptions:
    """Weights of points.

    :raises InputError: a number out of range
    """

    influences: int = field(default=4, metadata={"help": "most joints that move a point", "range": (1, 64)})
    sharpness: float = field(
        default=1.0,
        metadata={
            "help": "how far joints of --joints keep to their own: at 4, weights fall off about twice as fast as at 1",
            "range": (0.01, 100.0),
        },
    )
    smoothing: float = field(
        default=2.0,
        metadata={"help": "weights of --from are smoothed over this length along the surface", "unit": "mm",
                  "range": (0.0, 50.0)},
    )  # fmt: skip
    iterations: int = field(default=10, metadata={"help": "rounds of --optimise", "range": (1, 1000)})
    evenness: float = field(
        default=0.3,
        metadata={
            "help": "how much --optimise keeps weights even from point to point: more is smoother and misses more",
            "range": (0.0, 100.0),
        },
    )

    def __post_init__(self) -> None:
        check_ranges(self)
