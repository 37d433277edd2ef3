"""Tables of sliders: TOML as below, and CSV in two forms (`csv_table`).

units = "mm"                                # of translations: stage (default), mm, cm, m

[slider.noseWidth]
group = "nose"
range = [-1, 1]                             # default [0, 1]
default = 0                                 # default 0, or the minimum
mirror = "otherSide"                        # naming it on one side is enough
channels = { "nostrilLeft:tx" = 3, "lid*:sx" = [[-1, -0.1], [0, 0], [1, 0.3]] }
shapes = { jawOpen = 1, mouthPucker = { gain = 0.5, curve = [[0, 0], [1, 1]] } }
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.names import fits_joint, unmatched
from facepipe.core.reading import read_csv, read_toml
from facepipe.declare import from_json
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
_LIST = ("slider", "target", "gain")
_SETTINGS = ("group", "min", "max", "default", "mirror")
_BIAS = ("b", "bias")
_NUMERIC = set("0123456789+-.,eE: ")

Row = tuple[str, Mapping[str, str]]  # the trail to it, column -> text; columns without a text are left out


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
    # b is no slider of its own, which a user could set: it rides on one that moves the same
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


def read(path: Path) -> SliderTable:
    """:raises InputError: not readable, no CSV, or neither form"""
    delimiter, lines = read_csv(path, MOST_BYTES)
    if delimiter == ";":
        lines = [
            (number, [(cell.replace(",", ".") if set(cell) <= _NUMERIC else cell) for cell in cells])
            for number, cells in lines
        ]
    if len(lines) < 2:
        raise InputError(path, f"{len(lines)} rows, expected a header and sliders")
    header = lines[0][1]
    twice = [name for name, times in Counter(header).items() if name and times > 1]
    if twice or not all(header[1:]):
        found = f"column '{twice[0][:40]}' twice" if twice else "a column without name"
        raise InputError(f"{path} -> line 1", f"{found}, expected each column named, once")
    rows: list[Row] = []
    for number, cells in lines[1:]:
        if len(cells) > len(header):
            raise InputError(f"{path} -> line {number}", f"{len(cells)} cells, expected {len(header)}")
        rows.append(
            (f"{path} -> line {number}", {name: cell for name, cell in zip(header, cells, strict=False) if cell})
        )
    others = [name for name in header if name not in (*_LIST, *_SETTINGS, "curve")]
    if any(":" in name for name in others) or not set(_LIST[1:]) & set(header):
        return _matrix(path, header, rows)
    return _list(path, header, rows)


def _list(path: Path, header: Sequence[str], rows: Sequence[Row]) -> SliderTable:
    """A row for each thing that a slider drives."""
    others = [name for name in header if name not in (*_LIST, *_SETTINGS, "curve")]
    missing = [name for name in _LIST if name not in header]
    if missing or others:
        found = f"no column '{missing[0]}'" if missing else f"column '{others[0][:40]}'"
        expected = f"{', '.join(_LIST)}, and curve, {', '.join(_SETTINGS)} where needed"
        raise InputError(f"{path} -> line 1", f"{found}, expected columns {expected}")
    drives: dict[str, list[Drive]] = {}
    settings: dict[str, dict[str, str]] = {}
    places: dict[str, str] = {}
    for where, row in rows:
        name, target = _needed(where, row, "slider"), _needed(where, row, "target")
        curve: Curve | None = None
        if "curve" in row:
            knots = [knot.partition(":") for knot in row["curve"].split()]
            curve = tuple((_number(where, "knot", at), _number(where, "knot", amount)) for at, _, amount in knots)
        gain = _number(where, "gain", _needed(where, row, "gain"))
        driven = drives.setdefault(name, [])
        if target in {one.target for one in driven}:
            raise InputError(where, f"target '{target[:60]}' of slider '{name[:60]}' twice, expected each once")
        driven.append(Drive(target=target, gain=gain, curve=curve, where=f"{where} -> {name[:60]}"))
        above = settings.setdefault(name, {})
        for key in _SETTINGS:
            if key in row and above.setdefault(key, row[key]) != row[key]:
                both = f"{key} '{row[key][:40]}', and '{above[key][:40]}' in a row above"
                raise InputError(where, f"{both}, expected the same (or nothing)")
        places.setdefault(name, where)
    rules = [_csv_rule(f"{places[name]} -> {name[:60]}", name, settings[name], drives[name]) for name in drives]
    return SliderTable(rules=tuple(rules), where=str(path))


def _matrix(path: Path, header: Sequence[str], rows: Sequence[Row]) -> SliderTable:
    first, targets = header[0], [name for name in header[1:] if name not in _SETTINGS]
    if not targets:
        raise InputError(f"{path} -> line 1", f"{len(header)} columns, expected slider, and one per JOINT:CHANNEL")
    number = next((name for name in targets if set(name) <= _NUMERIC), None)
    if number is not None:
        raise InputError(f"{path} -> line 1", f"column '{number[:40]}', expected a header")
    rules: list[SliderRule] = []
    bias: list[Bias] = []
    for where, row in rows:
        name = _needed(where, row, first)
        gains = {target: _number(where, target, row.get(target, "0")) for target in targets}
        if name.lower() in _BIAS:
            if bias:
                raise InputError(where, "a second row b, expected one")
            bias += [Bias(target, ":" in target, gain, f"{where} -> {name}") for target, gain in gains.items()]
            continue
        where = f"{where} -> {name[:60]}"
        # zeros of a matrix are no entries: each would author a channel that does nothing
        drives = [Drive(target=target, gain=gain, where=where) for target, gain in gains.items() if gain]
        rules.append(_csv_rule(where, name, {key: row[key] for key in _SETTINGS if key in row}, drives))
    return SliderTable(rules=tuple(rules), bias=tuple(bias), where=str(path))


def _csv_rule(where: str, name: str, settings: Mapping[str, str], drives: Sequence[Drive]) -> SliderRule:
    def number(key: str, otherwise: float) -> float:
        return _number(where, key, settings[key]) if key in settings else otherwise

    return SliderRule(
        name=name,
        group=settings.get("group", ""),
        minimum=number("min", 0.0),
        maximum=number("max", 1.0),
        default=number("default", 0.0) if "default" in settings else None,
        mirror=settings.get("mirror"),
        channels=tuple(drive for drive in drives if ":" in drive.target),
        shapes=tuple(drive for drive in drives if ":" not in drive.target),
        where=where,
    )


def _needed(where: str, row: Mapping[str, str], column: str) -> str:
    if column not in row:
        raise InputError(where, f"nothing in column '{column[:40]}', expected something")
    return row[column]


def _number(where: str, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(where, f"{what[:60]} '{text[:40]}', expected a number") from None
    check_number(where, what[:60], value)
    return value


@dataclass(frozen=True, kw_only=True)
class _Driven:
    gain: float | None = None
    curve: Curve | None = None

    def __post_init__(self) -> None:
        if self.gain is None and self.curve is None:
            raise InputError("gain", "none, and no curve, expected one of them")


_Targets = Mapping[str, float | Curve | _Driven]


@dataclass(frozen=True, kw_only=True)
class _Slider:
    group: str = ""
    range: tuple[float, float] = (0.0, 1.0)
    default: float | None = None
    mirror: str = ""
    channels: _Targets = field(default_factory=dict)
    shapes: _Targets = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _Table:
    slider: Mapping[str, _Slider] = field(default_factory=dict)
    units: str = "stage"


def read_table(path: Path) -> SliderTable:
    """The sliders of a .toml or .csv file; what they drive is checked against the face later.

    :raises InputError: another suffix, not readable, or damaged
    """
    if path.suffix.lower() == ".csv":
        return read(path)
    if path.suffix.lower() != ".toml":
        raise InputError(path, f"suffix '{path.suffix[:20]}', expected one of .toml, .csv")
    table, where = from_json(_Table, read_toml(path, MOST_BYTES), str(path)), str(path)
    if not table.slider:
        raise InputError(where, "no sliders, expected tables like [slider.noseWidth]")
    rules = []
    for name, slider in table.slider.items():
        trail = f"{where} -> slider {name[:60]}"
        rules.append(
            SliderRule(
                name=name,
                group=slider.group,
                minimum=float(slider.range[0]),
                maximum=float(slider.range[1]),
                default=None if slider.default is None else float(slider.default),
                mirror=slider.mirror or None,
                channels=_drives(f"{trail} -> channels", slider.channels),
                shapes=_drives(f"{trail} -> shapes", slider.shapes),
                where=trail,
            )
        )
    return SliderTable(rules=tuple(rules), units=table.units, where=where)


def _drives(where: str, targets: _Targets) -> tuple[Drive, ...]:
    drives = []
    for target, value in targets.items():
        driven = value
        if not isinstance(driven, _Driven):
            driven = _Driven(curve=driven) if isinstance(driven, tuple) else _Driven(gain=driven)
        gain = 1.0 if driven.gain is None else float(driven.gain)
        curve = None if driven.curve is None else tuple((float(at), float(amount)) for at, amount in driven.curve)
        drives.append(Drive(target=target, gain=gain, curve=curve, where=f"{where} -> {target[:60]}"))
    return tuple(drives)
