"""What a table says of sliders: their settings, and what they drive by patterns of joints and blendshapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.names import fits_joint, unmatched
from facepipe.parts import Curve, Slider
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import curve_fault, with_entries

UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}  # of translations, in metres

_LARGEST = 1e9  # of a number: in any unit it stays finite in float32

Channels = dict[tuple[str, str], tuple[float, Curve | None]]  # (joint, channel) -> gain, curve
Shapes = dict[str, tuple[float, Curve | None]]


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
    found = [one for one in joints if fits_joint(pattern, one)]
    if not found:
        leaves = [one.rpartition("/")[2] for one in joints]
        raise InputError(where, f"'{pattern[:60]}' {unmatched(pattern, leaves, 'joints')}")
    return [(joint, one) for joint in found for one in channels]


def shape_targets(where: str, target: str, shapes: Sequence[str]) -> list[str]:
    """The shapes that a pattern stands for.

    :raises InputError: it matches none
    """
    found = [target] if target in shapes else [one for one in shapes if fnmatchcase(one, target)]
    if not found:
        raise InputError(where, f"'{target[:60]}' {unmatched(target, shapes, 'shapes')}")
    return found


def check_number(where: str, what: str, value: float) -> None:
    """:raises InputError: NaN, infinity, or a number beyond reason"""
    if not -_LARGEST <= value <= _LARGEST:
        raise InputError(where, f"{what} {str(value)[:20]}, expected a finite number of at most {_LARGEST:g}")
