"""Options of sliders made from blendshapes."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.options import check_ranges
from facepipe.processors.sliders.shape_names import PAIRS, parse_pairs


@dataclass(frozen=True, kw_only=True)
class ShapeSliderOptions:
    """Which shapes make one slider, how bones follow them, and what becomes of those that bones hardly reach.

    :raises InputError: an option out of range, or pairs that are none
    """

    pairs: str = field(
        default=PAIRS,
        metadata={"help": "last words of shapes that are the two ends of one slider, low:high, comma between; '' none"},
    )
    least_reach: float = field(
        default=0.1,
        metadata={
            "help": "a slider whose bones reach less of the motion of its shapes (1 - RMS left / RMS of the motion) is "
            "left out; with --residual it is made of its shapes alone",
            "range": (0.0, 1.0),
        },
    )
    least_effect: float = field(
        default=0.1,
        metadata={
            "help": "channels that move no point by this share of the pose's largest motion, or by no more than "
            "--threshold-mm, are left out, and the others fitted again; 0 keeps all",
            "range": (0.0, 1.0),
        },
    )
    regularise: float = field(
        default=0.1,
        metadata={
            "help": "weight of the mean square strain of the bones beside that of the distances: calm poses add up "
            "better",
            "range": (0.0, 1e6),
        },
    )
    residual: bool = field(
        default=False,
        metadata={"help": "sliders also drive what bones can't reach as sparse blendshapes SHAPE_residual"},
    )
    threshold_mm: float = field(
        default=0.1,
        metadata={
            "help": "a distance that is good enough: points that bones leave further off are in the residual",
            "range": (1e-6, 1e6),
            "unit": "mm",
        },
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_pairs(self.pairs)
