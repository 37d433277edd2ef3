"""Options of sliders: made from blendshapes, and learned by a network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import check_ranges, option
from facepipe.verbs.sliders.shape_names import PAIRS, parse_pairs

DISTIL = "distil_"  # what they begin with among the options of an export


@dataclass(frozen=True, kw_only=True)
class ShapeSliderOptions:
    """Which shapes make one slider, how bones follow them, and what becomes of those that bones hardly reach.

    :raises InputError: an option out of range, or pairs that are none
    """

    pairs: str = option(
        PAIRS, "last words of shapes that are the two ends of one slider, low:high, comma between; '' none"
    )
    least_reach: float = option(
        0.1,
        "a slider whose bones reach less of the motion of its shapes (1 - RMS left / RMS of the motion) is "
        "left out; with --residual it is made of its shapes alone",
        0.0,
        1.0,
    )
    least_effect: float = option(
        0.1,
        "channels that move no point by this share of the pose's largest motion, or by no more than "
        "--threshold-mm, are left out, and the others fitted again; 0 keeps all",
        0.0,
        1.0,
    )
    regularise: float = option(
        0.1,
        "weight of the mean square strain of the bones beside that of the distances: calm poses add up better",
        0.0,
        1e6,
    )
    residual: bool = option(False, "sliders also drive what bones can't reach as sparse blendshapes SHAPE_residual")
    threshold_mm: float = option(
        0.1, "a distance that is good enough: points that bones leave further off are in the residual", 1e-6, 1e6, "mm"
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_pairs(self.pairs)


@dataclass(frozen=True, kw_only=True)
class DistilOptions:
    """The network, and its training."""

    width: int = option(32, "hidden units", 1, 1024)
    activation: Literal["relu", "tanh"] = option("relu", "relu bends sharply, as curves do; tanh smoothly")
    seed: int = option(0, "of samples and first weights", 0, (1 << 32) - 1)
    steps: int = option(6000, "of training at most, each a batch of 256 slider vectors", 100, 200_000)
    threshold_mm: float = option(0.1, "exit code 1 where a point is further off than this", 0.0, 1e6, "mm")
