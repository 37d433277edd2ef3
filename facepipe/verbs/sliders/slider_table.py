"""A table of sliders: their settings, what they drive by patterns, and the constant b of gamma = W^T alpha + b."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import NamedTuple, TypeVar

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.names import fits_joint, unmatched
from facepipe.parts import Curve, Slider
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import channel_entries, curve_fault, shape_entries, with_entries

UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}  # of translations, in metres

_LARGEST = 1e9  # of a number: in any unit it stays finite in float32

Channels = dict[tuple[str, str], tuple[float, Curve | None]]  # (joint, channel) -> gain, curve
Shapes = dict[str, tuple[float, Curve | None]]
Target = TypeVar("Target")
MOST_BYTES = 1 << 22
MOST_SLIDERS = 4096
_MOST_DRIVEN = 1 << 18


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One thing that a slider drives, or several by a pattern.

    :raises InputError: a gain beyond reason, or a damaged curve
    """

    target: str  # "joint:channel" or a shape; the channel may be a kind (t, r, s)
    gain: float = 1.0
    curve: Curve | None = None
    where: str

    def __post_init__(self) -> None:
        check_number(self.where, "gain", self.gain)
        for knot in self.curve or ():
            for number in knot:
                check_number(self.where, "knot", number)
        fault = None if self.curve is None else curve_fault(self.curve)
        if fault:
            raise InputError(self.where, fault)


@dataclass(frozen=True, kw_only=True)
class SliderRule:
    """One slider of a table.

    :raises InputError: numbers beyond reason, an empty range, or a default outside of it
    """

    name: str
    group: str = ""
    minimum: float = 0.0
    maximum: float = 1.0
    default: float | None = None  # None: 0, or the minimum where 0 is not in range
    mirror: str | None = None
    channels: tuple[Drive, ...] = ()
    shapes: tuple[Drive, ...] = ()
    where: str

    def __post_init__(self) -> None:
        for what, value in (("minimum", self.minimum), ("maximum", self.maximum), ("default", self.start)):
            check_number(self.where, what, value)
        low, start, high = (np.float32(one) for one in (self.minimum, self.start, self.maximum))
        if low >= high:
            raise InputError(self.where, f"range {low:g} to {high:g}, expected a minimum below the maximum")
        if not low <= start <= high:
            raise InputError(self.where, f"default {start:g}, expected {low:g} to {high:g}")

    @property
    def start(self) -> float:
        """The default."""
        if self.default is not None:
            return self.default
        return 0.0 if self.minimum <= 0 <= self.maximum else self.minimum

    def resolve(self, joints: Sequence[str], shapes: Sequence[str], unit: float) -> Slider:
        """The slider on a face.

        :param unit: what translations are multiplied by
        :raises InputError: an unknown channel, or a pattern that matches no joint or shape
        """
        channels: Channels = {}
        for drive in self.channels:
            for joint, channel in channel_targets(drive.where, drive.target, joints):
                # rotations are radians and scales factors on every stage: only translations are lengths
                factor = unit if channel.startswith("t") else 1.0
                channels[joint, channel] = (drive.gain * factor, drive.curve)
        driven: Shapes = {}
        for drive in self.shapes:
            for shape in shape_targets(drive.where, drive.target, shapes):
                driven[shape] = (drive.gain, drive.curve)
        settings = Slider(
            name=self.name,
            group=self.group,
            minimum=self.minimum,
            maximum=self.maximum,
            default=self.start,
            mirror=self.mirror,
        )
        return with_driven(settings, channels, driven)


def with_driven(slider: Slider, channels: Channels, shapes: Shapes) -> Slider:
    """A slider that drives these."""
    return with_entries(
        slider,
        [((joint, channel, gain), curve) for (joint, channel), (gain, curve) in channels.items()],
        [((shape, gain), curve) for shape, (gain, curve) in shapes.items()],
    )


def channel_targets(where: str, target: str, joints: Sequence[str]) -> list[tuple[str, str]]:
    """(joint, channel) pairs that ``pattern:channel`` stands for.

    :raises InputError: an unknown channel, or a pattern that matches none
    """
    pattern, _, channel = target.rpartition(":")
    channels = [one for one in CHANNELS if channel in (one, one[0])]
    if not channels or not pattern:
        raise InputError(where, f"'{target[:60]}', expected JOINT:CHANNEL, channels {' '.join(CHANNELS)}, or t r s")
    matching = [joint for joint in joints if fits_joint(pattern, joint)]
    if not matching:
        leaves = [joint.rpartition("/")[2] for joint in joints]
        raise InputError(where, f"'{pattern[:60]}' {unmatched(pattern, leaves, 'joints')}")
    return [(joint, one) for joint in matching for one in channels]


def shape_targets(where: str, target: str, shapes: Sequence[str]) -> list[str]:
    """The shapes that a pattern stands for.

    :raises InputError: it matches none
    """
    matching = [target] if target in shapes else [shape for shape in shapes if fnmatchcase(shape, target)]
    if not matching:
        raise InputError(where, f"'{target[:60]}' {unmatched(target, shapes, 'shapes')}")
    return matching


def check_number(where: str, what: str, value: float) -> None:
    """:raises InputError: NaN, infinity, or a number beyond reason"""
    if not -_LARGEST <= value <= _LARGEST:
        raise InputError(where, f"{what} {str(value)[:20]}, expected a finite number of at most {_LARGEST:g}")


class Bias(NamedTuple):
    """What is added to a target whatever the sliders say."""

    target: str  # pattern of "joint:channel", or of shapes
    is_channel: bool
    amount: float
    where: str


def with_bias(
    sliders: Sequence[Slider], bias: Sequence[Bias], joints: Sequence[str], shapes: Sequence[str], unit: float
) -> tuple[Slider, ...]:
    """Sliders that together stand for ``W^T alpha + b``: `sliders` are straight, their gains are W.

    A straight entry adds ``gain * (alpha - default)``, so what is carried is ``b + W^T default``: per target by the
    first slider that moves it (or the first of all), as a curve that is straight over its range.

    :param unit: what translations are multiplied by
    :raises InputError: unknown channels, or patterns that match no joint or shape
    """
    channels: list[Channels] = [
        {(joint, channel): (gain, curve) for (joint, channel, gain), curve in channel_entries(slider)}
        for slider in sliders
    ]
    driven: list[Shapes] = [
        {shape: (gain, curve) for (shape, gain), curve in shape_entries(slider)} for slider in sliders
    ]
    for constant in bias:
        if constant.is_channel:
            for target in channel_targets(constant.where, constant.target, joints):
                _carry(sliders, channels, target, constant.amount * (unit if target[1].startswith("t") else 1.0))
        else:
            for shape in shape_targets(constant.where, constant.target, shapes):
                _carry(sliders, driven, shape, constant.amount)
    return tuple(with_driven(*each) for each in zip(sliders, channels, driven, strict=True))


def _carry(
    sliders: Sequence[Slider], driven: Sequence[dict[Target, tuple[float, Curve | None]]], target: Target, amount: float
) -> None:
    moving = [i for i, own in enumerate(driven) if own.get(target, (0.0, None))[0]]
    amount += sum(driven[i][target][0] * sliders[i].default for i in moving)
    if not amount:
        return
    first = moving[0] if moving else 0
    slider, (gain, _) = sliders[first], driven[first].get(target, (0.0, None))
    ends = (slider.minimum, slider.maximum)
    driven[first][target] = (1.0, tuple((end, gain * (end - slider.default) + amount) for end in ends))


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
