"""Limits of bone coefficients: those of the rig, and rules of a JSON file over them.

    {
      "joints": {
        "*": {"t": [-0.1, 0.1], "r": [-0.5, 0.5], "s": [0.8, 1.25]},
        "jaw": {"rx": [-0.05, 0.4], "tz": [null, 0]}
      },
      "lock": ["root:*", "eye*:s"],
      "units": "stage"
    }

Names of joints are patterns of their paths or last names; later ones win. Channels are single (``tx``), of a kind
(``t``, ``r``, ``s``), or ``*`` all; the narrower name wins. ``null`` is no limit; scales without stay above 0.01.
Rotations are radians, scales factors (1 is rest), translations ``units``: ``stage``, ``mm``, ``cm`` or ``m``. ``lock``
keeps channels, or ``*`` all of them, at rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import fits_joint, unmatched
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json
from facepipe.parts import BoneLimits
from facepipe.rig import CHANNELS, rest_coefficients
from facepipe.verbs.apply_bones import check_limits
from facepipe.verbs.fit_bones.checks import LEAST_SCALE

Range = tuple[float | None, float | None]

_MOST_BYTES = 1 << 24
_UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}
_LARGEST = 1e9  # of a limit: in any unit it stays finite in float32


@dataclass(frozen=True, kw_only=True)
class LimitRules:
    """Limits by patterns of joints; the fields are explained above.

    :raises InputError: channels or units that are unknown, limits that are not finite, or a lower one above its upper
    """

    joints: tuple[tuple[str, Mapping[str, Range]], ...] = ()  # (pattern, channel or kind -> limits), later ones win
    lock: tuple[str, ...] = ()  # "pattern:channel"
    units: str = "stage"
    where: str = field(default="limits", compare=False)  # for messages

    def __post_init__(self) -> None:
        if self.units not in _UNITS:
            raise InputError(f"{self.where} -> units", f"'{self.units}', expected one of {', '.join(_UNITS)}")
        for pattern, channels in self.joints:
            for channel, pair in channels.items():
                where = f"{self.where} -> joints -> {pattern} -> {channel}"
                _channels(where, channel)
                _check_pair(where, pair)
        for word in self.lock:
            where = f"{self.where} -> lock -> {word}"
            pattern, colon, channel = word.rpartition(":")
            if not (pattern and colon):
                raise InputError(where, "expected JOINT:CHANNEL, like jaw:tx, eye*:s or root:*")
            _channels(where, channel)

    def resolve(
        self, joints: Sequence[str], meters_per_unit: float, base: BoneLimits | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """(j, 9) lower and upper limits of joints, over those of `base`; float32 values inside what the rules allow.

        :raises InputError: a pattern that matches no joint, or a lower limit of `base` above its upper one
        """
        lower, upper = _base_limits(joints, base)
        meters = _UNITS[self.units]
        scale = 1.0 if meters is None else meters / meters_per_unit
        for pattern, channels in self.joints:
            rows = _matching(f"{self.where} -> joints -> {pattern}", pattern, joints)
            for name in sorted(channels, key=lambda channel: -len(_channels("", channel))):  # * first, single ones last
                for column in _channels("", name):
                    # inwards: the nearest float32 to a limit may lie beyond it
                    low, high = _rounded_inwards(channels[name], scale if column < 3 else 1.0)
                    lower[rows, column], upper[rows, column] = low, high
                    if channels[name][0] is None:
                        lower[rows, column] = min(_none_below(1)[0, column], high)
        rest = rest_coefficients(len(joints))
        for word in self.lock:
            pattern, _, channel = word.rpartition(":")
            at = np.ix_(_matching(f"{self.where} -> lock -> {word}", pattern, joints), _channels("", channel))
            lower[at] = upper[at] = rest[at]
        return lower, upper

    def to_json(self) -> dict[str, Any]:
        """The rules as recipes hold them, their order kept."""
        joints = [
            [pattern, {key: list(channels[key]) for key in sorted(channels)}] for pattern, channels in self.joints
        ]
        return {"joints": joints, "lock": list(self.lock), "units": self.units}


@dataclass(frozen=True, kw_only=True)
class _KeptRules:
    joints: tuple[tuple[str, Mapping[str, Range]], ...]
    lock: tuple[str, ...]
    units: str


@dataclass(frozen=True, kw_only=True)
class _LimitsFile:
    joints: Mapping[str, Mapping[str, Range]] = field(default_factory=dict)
    lock: tuple[str, ...] = ()
    units: str = "stage"


def read_limits(path: Path) -> LimitRules:
    """The rules of a JSON file; its joints are checked against the rig later.

    :raises InputError: not such JSON
    """
    file = from_json(_LimitsFile, read_json_object(path, _MOST_BYTES), str(path))
    return LimitRules(joints=tuple(file.joints.items()), lock=file.lock, units=file.units, where=str(path))


def limits_from_json(content: object, where: str) -> LimitRules:
    """The rules that `LimitRules.to_json` gave.

    :param where: for messages
    :raises InputError: another structure, or no limits
    """
    kept = from_json(_KeptRules, content, where)
    return LimitRules(joints=kept.joints, lock=kept.lock, units=kept.units, where=where)


def _check_pair(where: str, pair: Range) -> None:
    low, high = pair
    for value in (low, high):
        if value is not None and not -_LARGEST <= value <= _LARGEST:  # NaN and integers beyond any float too
            raise InputError(where, f"{str(value)[:20]}, expected a finite number, or null for no limit")
    if low is not None and high is not None and low > high:
        raise InputError(where, f"lower limit {low:g} above the upper {high:g}")


def _channels(where: str, name: str) -> list[int]:
    """Numbers of the channels that a name stands for."""
    numbers = [number for number, channel in enumerate(CHANNELS) if name in (channel, channel[0], "*")]
    if not numbers:
        raise InputError(where, f"unknown channel '{name[:20]}', expected {' '.join(CHANNELS)}, or t r s")
    return numbers


def _matching(where: str, pattern: str, joints: Sequence[str]) -> list[int]:
    numbers = [number for number, path in enumerate(joints) if fits_joint(pattern, path)]
    if not numbers:
        raise InputError(where, unmatched(pattern, [joint.rpartition("/")[2] for joint in joints], "joints"))
    return numbers


def _base_limits(joints: Sequence[str], base: BoneLimits | None) -> tuple[FloatArray, FloatArray]:
    if base is None:
        return _none_below(len(joints)), np.full((len(joints), 9), np.inf)
    check_limits(joints, base)
    return np.array(base.lower, dtype=np.float64), np.array(base.upper, dtype=np.float64)


def _none_below(count: int) -> FloatArray:
    """(count, 9) lower limits where none are given: no joint turns inside out."""
    return np.tile([-np.inf] * 6 + [_rounded_inwards((LEAST_SCALE, None), 1.0)[0]] * 3, (count, 1))


def _rounded_inwards(pair: Range, factor: float) -> tuple[float, float]:
    """Limits as float32, which coefficients are stored in: not beyond what was asked for, unless they meet there."""
    low = -np.inf if pair[0] is None else pair[0] * factor
    high = np.inf if pair[1] is None else pair[1] * factor
    inside_low, inside_high = np.float32(low), np.float32(high)
    if float(inside_low) < low:
        inside_low = np.nextafter(inside_low, np.float32(np.inf))
    if float(inside_high) > high:
        inside_high = np.nextafter(inside_high, np.float32(-np.inf))
    if inside_low > inside_high:
        inside_low = inside_high = np.float32(low)
    return float(inside_low), float(inside_high)
