"""How a network for first guesses is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass

from facepipe.declare import check_ranges, option

# of a step: landmarks of people, renders whose truth is known, pictures on the joint loss
LANDMARK_BATCH, BATCH, JOINT_BATCH = 256, 32, 8


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """How long, and on what.

    :raises InputError: a number out of range
    """

    people: int = option(100_000, "random people to learn from first, by their landmarks alone", 0, 100_000_000)
    renders: int = option(2000, "random renders of FACE with known parameters", 0, 200_000)
    epochs: int = option(4, "passes over these renders", 0, 1000)
    steps: int = option(400, f"steps on the joint loss after that, with {JOINT_BATCH} pictures each", 0, 1_000_000)
    seed: int = option(0, "seed of people, initial weights and order", 0, 2**31 - 1)

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def landmark_batches(self) -> int:
        """Steps on landmarks alone."""
        return math.ceil(self.people / LANDMARK_BATCH)

    @property
    def batches(self) -> int:
        """Steps on renders."""
        return self.epochs * math.ceil(self.renders / BATCH)

    @property
    def total(self) -> int:
        """Renders, batches and steps, as they are counted while they are made."""
        return self.renders + self.landmark_batches + self.batches + self.steps
