"""A table of sliders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.parts import Slider
from facepipe.processors.sliders.bias import Bias, with_bias
from facepipe.processors.sliders.rules import UNITS, SliderRule

MOST_BYTES = 1 << 22
MOST_SLIDERS = 4096
_MOST_DRIVEN = 1 << 18


@dataclass(frozen=True, kw_only=True)
class SliderTable:
    """The sliders of a table, by patterns.

    :raises InputError: no slider or too many, a name twice, or unknown units
    """

    rules: tuple[SliderRule, ...]
    bias: tuple[Bias, ...] = ()  # what is added whatever the sliders say
    units: str = "stage"  # of translations
    where: str = "table"  # for messages

    def __post_init__(self) -> None:
        if self.units not in UNITS:
            raise InputError(f"{self.where} -> units", f"'{self.units[:20]}', expected one of {', '.join(UNITS)}")
        if not 0 < len(self.rules) <= MOST_SLIDERS:
            raise InputError(self.where, f"{len(self.rules)} sliders, expected 1 to {MOST_SLIDERS}")
        name, times = Counter(rule.name for rule in self.rules).most_common(1)[0]
        if times > 1:
            raise InputError(self.where, f"slider '{name[:60]}' {times} times, expected each once")

    def resolve(self, joints: Sequence[str], shapes: Sequence[str], meters_per_unit: float) -> tuple[Slider, ...]:
        """The sliders on a face.

        :raises InputError: unknown channels, or patterns that match no joint or shape
        """
        meters = UNITS[self.units]
        unit = 1.0 if meters is None else meters / meters_per_unit
        sliders, driven = [], 0
        for rule in self.rules:
            sliders.append(rule.resolve(joints, shapes, unit))
            driven += len(sliders[-1].channels) + len(sliders[-1].shapes)
            if driven > _MOST_DRIVEN:
                raise InputError(self.where, f"drives more than {_MOST_DRIVEN} channels and shapes")
        return with_bias(sliders, self.bias, joints, shapes, unit) if self.bias else tuple(sliders)
