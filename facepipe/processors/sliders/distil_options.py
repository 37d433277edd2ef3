"""What may be set about learning sliders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import option

DISTIL = "distil_"  # what they begin with among the options of an export


@dataclass(frozen=True, kw_only=True)
class DistilOptions:
    """The network, and its training."""

    width: int = option(32, "hidden units", 1, 1024)
    activation: Literal["relu", "tanh"] = option("relu", "relu bends sharply, as curves do; tanh smoothly")
    seed: int = option(0, "of samples and first weights", 0, (1 << 32) - 1)
    steps: int = option(6000, "of training at most, each a batch of 256 slider vectors", 100, 200_000)
    threshold_mm: float = option(0.1, "exit code 1 where a point is further off than this", 0.0, 1e6, "mm")
