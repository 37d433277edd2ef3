"""Options of splitting scanned composites into a person's own shapes."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.declare import Ranged, option


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
