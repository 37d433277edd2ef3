"""Limits of bone coefficients: those of the rig, rules of a JSON file over them, and checks of a fit's input.

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
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import fits_joint, unmatched
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json
from facepipe.parts import BoneLimits, FaceParts
from facepipe.rig import CHANNELS, Rig, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe.verbs.bone_payload import check_limits
from facepipe.verbs.whole_faces import check_invertible, check_spaces

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.targets import Target

LEAST_SCALE = 0.01  # where a lower limit of a scale is infinite
_EVEN = 1e-4  # scales that differ less, relative to the largest, are the same
_SHOWN = 4  # names of a list
_FARTHEST = 1000.0  # sizes of the face: no pose, and beyond what its numbers stand for
_OTHER_SIZE = 4.0  # times as large, or as small: perhaps other units
Range = tuple[float | None, float | None]

_MOST_BYTES = 1 << 24
_UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}
_LARGEST = 1e9  # of a limit: in any unit it stays finite in float32


def check_rig(where: str, parts: FaceParts, rig: Rig) -> None:
    """Check that bones move points.

    :raises InputError: no joints, or no point that follows one
    :raises TopologyError: singular bind transforms or spaces
    """
    if not rig.joints:
        raise InputError(where, "has no joints, expected a skinned face (`facepipe skin` makes one)")
    if rig.influences[:, : len(rig.joints)].nnz == 0:
        raise InputError(where, "no point follows a joint, expected a skinned face (`facepipe skin` makes one)")
    rig.require_linear("the fit")
    check_spaces(where, parts)
    for joint, bind, rest in zip(rig.joints, parts.skeleton.bind_transforms, rig.rest, strict=True):
        check_invertible(f"{where} -> {joint}", "bind transform", bind)
        check_invertible(f"{where} -> {joint}", "rest transform", rest)


def rest_shear(rig: Rig) -> list[str]:
    """A warning of joints whose rest scale is not the same in all directions: what turns at or below them shears."""
    scales = np.abs(decompose(rig.rest).scale)
    uneven = np.flatnonzero(scales.max(axis=1) - scales.min(axis=1) > _EVEN * scales.max(axis=1))
    if not len(uneven):
        return []
    names = some([rig.joints[number] for number in uneven])
    return [f"rest scale of {names} differs by direction: rotations at and below shear, which not every engine keeps"]


def some(names: list[str]) -> str:
    """A few of the names, and how many more."""
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def check_settings(where: str, settings: Mapping[str, float]) -> None:
    """Check numbers by their names.

    :raises InputError: one that is negative or not finite, or sparsity, which counts in thresholds, without threshold
    """
    for name, value in settings.items():
        if not (np.isfinite(value) and value >= 0):
            raise InputError(where, f"{name} {value:g}, expected 0 or more")
    if settings["sparsity"] > 0 and settings["threshold"] == 0:
        raise InputError(where, "threshold 0 of a sparse fit, expected more: strain counts in thresholds")


def check_rest(rig: Rig, parent_world: FloatArray | None) -> None:
    """Check that joints (under a parent, default the skeleton's place) have a size in every direction.

    :raises InputError: one that has none
    """
    worlds = rig.joint_worlds(rig.rest, parent_world)
    flat = np.flatnonzero(np.linalg.matrix_rank(worlds[:, :3, :3]) < 3)
    if len(flat):
        raise InputError(f"{rig.name} -> {rig.joints[flat[0]]}", "singular rest transform, expected an invertible one")


def checked_limits(rig: Rig, lower: FloatArray | None, upper: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """(m, 9) lower and upper limits; infinite where there are none, but those of scales.

    :raises InputError: arrays that don't fit, a lower limit above its upper one, or limits without a finite number
    """
    shape, both = (len(rig.joints), 9), []
    for given, default in ((lower, -np.inf), (upper, np.inf)):
        limits = np.full(shape, default) if given is None else np.array(given, dtype=np.float64)
        if limits.shape != shape or np.isnan(limits).any():
            raise InputError(rig.name, f"limits {limits.shape}, expected {shape} numbers")
        both.append(limits)
    low, high = both
    # a scale of 0 makes the joint's matrix singular, one below mirrors: a descent without limit may go there
    low[:, 6:] = np.where(np.isneginf(low[:, 6:]), LEAST_SCALE, low[:, 6:])
    wrong = np.argwhere((low > high) | np.isposinf(low) | np.isneginf(high))
    if len(wrong):
        joint, channel = wrong[0]
        least, most = low[joint, channel], high[joint, channel]
        crossed = f"lower limit {least:g} above the upper {most:g}"
        what = crossed if least > most else f"limits {least:g} to {most:g}, expected finite ones"
        raise InputError(f"{rig.name} -> {rig.joints[joint]} -> {CHANNELS[channel]}", what)
    return low, high


def checked_weights(rig: Rig, weights: FloatArray | None) -> FloatArray:
    """(n,) weights of points, the largest 1; all 1 without any given.

    :raises InputError: another number of them, or one that is negative or not finite
    """
    if weights is None:
        return np.ones(len(rig.points))
    given = np.asarray(weights, dtype=np.float64)
    if given.shape != (len(rig.points),) or not (np.isfinite(given) & (given >= 0)).all():
        raise InputError(rig.name, f"point weights {given.shape}, expected {len(rig.points)} of 0 or more")
    largest = float(given.max(initial=0.0))
    return given / largest if largest > 0 else given


def check_targets(targets: Sequence[Target], rest: FloatArray, weights: FloatArray) -> None:
    """Check targets against the (n, 3) points of the face at rest, of which those with a weight (n,) count.

    :raises InputError: no target, another number of points, no point that counts, or points far from any pose
    """
    if not targets:
        raise InputError("targets", "none given, expected at least one")
    for target in targets:
        if target.points.shape[1] != len(rest):
            raise InputError(f"target {target.name}", f"{target.points.shape[1]:,} points, expected {len(rest):,}")
        counts = _counting(target, weights)
        if not counts.any():
            raise InputError(f"target {target.name}", "knows no point that counts")
        size = float(np.ptp(rest[counts], axis=0).max())
        farthest = float(np.abs(target.points[:, counts] - rest[counts].mean(axis=0)).max())
        if size > 0 and farthest > _FARTHEST * size:
            what = f"points {farthest / size:.3g} times the face's size away, expected less than {_FARTHEST:g}"
            raise InputError(f"target {target.name}", f"{what}: are its units right?")


def size_warning(target: Target, name: str, rest: FloatArray, weights: FloatArray) -> list[str]:
    """A line where a target is so much larger or smaller than the face that its units may be others."""
    counts = _counting(target, weights)
    size, sizes = np.ptp(rest[counts], axis=0).max(), np.ptp(target.points[:, counts], axis=1).max(axis=1)
    ratios = sizes / size if size > 0 else np.ones(1)
    ratio = float(ratios.max() if ratios.max() > _OTHER_SIZE else ratios.min())
    if 1 / _OTHER_SIZE <= ratio <= _OTHER_SIZE:
        return []
    return [f"{name}: is {ratio:.3g} times as large as the face: are its units right?"]


def _counting(target: Target, weights: FloatArray) -> BoolArray:
    counts: BoolArray = weights > 0
    return counts if target.known is None else counts & target.known


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
                low, high = pair
                for value in (low, high):
                    # NaN and integers beyond any float too
                    if value is not None and not -_LARGEST <= value <= _LARGEST:
                        raise InputError(where, f"{str(value)[:20]}, expected a finite number, or null for no limit")
                if low is not None and high is not None and low > high:
                    raise InputError(where, f"lower limit {low:g} above the upper {high:g}")
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
        lower, upper = _none_below(len(joints)), np.full((len(joints), 9), np.inf)
        if base is not None:
            check_limits(joints, base)
            lower, upper = np.array(base.lower, dtype=np.float64), np.array(base.upper, dtype=np.float64)
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
