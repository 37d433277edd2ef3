"""The pose in which a face is evaluated, as the options of an action."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from facepipe.declare import BONE_HELP, named_numbers, option

_NUMBERS: dict[str, Any] = {"parse": named_numbers, "kept": False}


@dataclass(frozen=True, kw_only=True)
class Posed:
    """Base of actions that pose a face."""

    weights: Mapping[str, float] = option(dict, "shape weight", flag="--set", metavar="SHAPE=WEIGHT", **_NUMBERS)
    bones: Mapping[str, float] = option(dict, BONE_HELP, flag="--bone", metavar="JOINT:CHANNEL=VALUE", **_NUMBERS)
    sliders: Mapping[str, float] = option(
        dict, "slider value, over those that are set", flag="--slider", metavar="SLIDER=VALUE", **_NUMBERS
    )
