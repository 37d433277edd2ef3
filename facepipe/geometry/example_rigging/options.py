"""Options of splitting scanned composites into a person's own shapes."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.options import check_ranges


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """How far shapes may go from their templates, and how far the scans and their weights are trusted.

    Spreads are standard deviations of what people and scans are expected to do. Lengths are in the unit of the points,
    millimetres: a face scaled needs them scaled alike.

    :raises InputError: a number out of range
    """

    shared_gain: float = field(
        default=0.2,
        metadata={"help": "spread of how much more or less than the template all shapes move", "range": (0.0, 100.0)},
    )
    own_gain: float = field(
        default=0.2,
        metadata={"help": "spread of how much more or less each shape moves by itself", "range": (0.0, 100.0)},
    )
    shared_turn: float = field(
        default=0.15,
        metadata={
            "help": "spread of how far the directions of all shapes are turned",
            "range": (0.0, 100.0),
            "unit": "rad",
        },
    )
    own_turn: float = field(
        default=0.15,
        metadata={
            "help": "spread of how far the direction of each shape is turned by itself",
            "range": (0.0, 100.0),
            "unit": "rad",
        },
    )
    field_length: float = field(
        default=25.0,
        metadata={
            "help": "distance over which gains and turns vary: about half of a muscle's length",
            "range": (1e-6, 1e6),
            "unit": "mm",
        },
    )
    detail: float = field(
        default=0.2,
        metadata={
            "help": "spread of what gains and turns don't hold, as a share of the template's motion; larger follows "
            "the scans more closely, and their errors too",
            "range": (0.0, 1e6),
        },
    )
    detail_length: float = field(
        default=15.0,
        metadata={
            "help": "distance over which such detail varies, and over which points hold gradients in place",
            "range": (1e-6, 1e6),
            "unit": "mm",
        },
    )
    noise: float = field(
        default=0.1,
        metadata={
            "help": "error expected of the composites' points, in each coordinate",
            "range": (1e-9, 1e6),
            "unit": "mm",
        },
    )
    noise_length: float = field(
        default=15.0,
        metadata={
            "help": "distance over which that error varies: points closer together tell the same",
            "range": (1e-6, 1e6),
            "unit": "mm",
        },
    )
    weight_spread: float = field(
        default=0.1,
        metadata={
            "help": "error expected of the given weights; 0 keeps them. Weights of 0 always stay 0",
            "range": (0.0, 10.0),
        },
    )
    largest_weight: float = field(
        default=1.2, metadata={"help": "weights found stay between 0 and this, or the given one", "range": (0.0, 100.0)}
    )
    alternations: int = field(
        default=3, metadata={"help": "times that shapes and weights are solved for", "range": (1, 100)}
    )

    def __post_init__(self) -> None:
        check_ranges(self)
