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

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reading import read_toml
from facepipe.declare import from_json
from facepipe.parts import Curve
from facepipe.verbs.sliders import csv_table
from facepipe.verbs.sliders.slider_table import MOST_BYTES, Drive, SliderRule, SliderTable


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
    readers = {".toml": _read_toml, ".csv": csv_table.read}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, f"suffix '{path.suffix[:20]}', expected one of {', '.join(readers)}")
    return reader(path)


def _read_toml(path: Path) -> SliderTable:
    """:raises InputError: not readable, no TOML, or not such a table"""
    table, where = from_json(_Table, read_toml(path, MOST_BYTES), str(path)), str(path)
    if not table.slider:
        raise InputError(where, "no sliders, expected tables like [slider.noseWidth]")
    rules = tuple(_rule(f"{where} -> slider {name[:60]}", name, slider) for name, slider in table.slider.items())
    return SliderTable(rules=rules, units=table.units, where=where)


def _rule(where: str, name: str, slider: _Slider) -> SliderRule:
    return SliderRule(
        name=name,
        group=slider.group,
        minimum=float(slider.range[0]),
        maximum=float(slider.range[1]),
        default=None if slider.default is None else float(slider.default),
        mirror=slider.mirror or None,
        channels=_drives(f"{where} -> channels", slider.channels),
        shapes=_drives(f"{where} -> shapes", slider.shapes),
        where=where,
    )


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
