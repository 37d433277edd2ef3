"""How controls are found for points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from facepipe.options import check_ranges


@dataclass(frozen=True, kw_only=True)
class InvertNeuralRigOptions:
    """How controls are found for points.

    :raises InputError: a number out of range
    """

    mode: Literal["lm", "adam"] = field(
        default="lm",
        metadata={"help": "bounded Levenberg-Marquardt, or Adam from random controls", "choices": ("lm", "adam")},
    )
    l1: float = field(
        default=2e-4,
        metadata={
            "help": "price of a control its whole range from its default",
            "unit": "mm2",
            "range": (0.0, 1e6),
        },
    )
    smoothness: float = field(
        default=1e-3,
        metadata={
            "help": "price of a change of speed by the range a frame, squared, in clips",
            "unit": "mm2",
            "range": (0.0, 1e6),
        },
    )
    starts: int = field(
        default=6,
        metadata={"help": "starts of frames that fit much worse than the others, or are few", "range": (1, 100)},
    )
    steps: int = field(default=60, metadata={"help": "most steps from a start (lm)", "range": (1, 1e6)})
    points: int = field(
        default=500, metadata={"help": "points that second derivatives are of, with bones (lm)", "range": (3, 1e7)}
    )
    accuracy_mm: float = field(
        default=0.01,
        metadata={
            "help": "how near targets are known, for what is told of controls",
            "unit": "mm",
            "range": (0, 10),
        },
    )
    adam_steps: int = field(default=1000, metadata={"help": "steps (adam)", "range": (1, 1e7)})
    adam_rate: float = field(
        default=0.05, metadata={"help": "first rate, of ranges; it falls to a hundredth (adam)", "range": (1e-6, 10.0)}
    )
    seed: int = field(default=0, metadata={"help": "of random starts", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)
