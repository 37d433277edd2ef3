"""Tables of sliders in TOML.

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

from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.reading import read_toml
from facepipe.parts import Curve
from facepipe.processors.sliders.slider_table import MOST_BYTES, Drive, SliderRule, SliderTable

_KEYS = ("slider", "units")
_SLIDER_KEYS = ("group", "range", "default", "mirror", "channels", "shapes")


def read(path: Path) -> SliderTable:
    """:raises InputError: not readable, no TOML, or not such a table"""
    content = read_toml(path, MOST_BYTES)
    where = str(path)
    _check_keys(where, content, _KEYS)
    sliders = content.get("slider", {})
    if not isinstance(sliders, dict) or not sliders:
        raise InputError(where, "no sliders, expected tables like [slider.noseWidth]")
    rules = tuple(_rule(f"{where} -> slider {name[:60]}", name, own) for name, own in sliders.items())
    return SliderTable(rules=rules, units=_text(where, content, "units", "stage"), where=where)


def _rule(where: str, name: str, content: object) -> SliderRule:
    if not isinstance(content, dict):
        raise InputError(where, f"{_shown(content)}, expected a table like [slider.noseWidth]")
    _check_keys(where, content, _SLIDER_KEYS)
    span = content.get("range", [0, 1])
    if not isinstance(span, list) or len(span) != 2 or not all(map(_is_number, span)):
        raise InputError(f"{where} -> range", f"{_shown(span)}, expected [minimum, maximum]")
    default = content.get("default")
    if default is not None and not _is_number(default):
        raise InputError(f"{where} -> default", f"{_shown(default)}, expected a number")
    return SliderRule(
        name=name,
        group=_text(where, content, "group", ""),
        minimum=_float(where, span[0]),
        maximum=_float(where, span[1]),
        default=None if default is None else _float(where, default),
        mirror=_text(where, content, "mirror", "") or None,
        channels=_drives(where, content, "channels"),
        shapes=_drives(where, content, "shapes"),
        where=where,
    )


def _drives(where: str, content: dict[str, Any], key: str) -> tuple[Drive, ...]:
    drives = content.get(key, {})
    if not isinstance(drives, dict):
        raise InputError(f"{where} -> {key}", f"{_shown(drives)}, expected a table of gains or curves")
    return tuple(_drive(f"{where} -> {key} -> {target[:60]}", target, value) for target, value in drives.items())


def _drive(where: str, target: str, value: object) -> Drive:
    if _is_number(value):
        return Drive(target=target, gain=_float(where, value), where=where)
    if isinstance(value, list):
        return Drive(target=target, curve=_curve(where, value), where=where)
    if isinstance(value, dict) and value:
        _check_keys(where, value, ("gain", "curve"))
        gain = value.get("gain", 1.0)
        if not _is_number(gain):
            raise InputError(f"{where} -> gain", f"{_shown(gain)}, expected a number")
        curve = _curve(where, value["curve"]) if "curve" in value else None
        return Drive(target=target, gain=_float(where, gain), curve=curve, where=where)
    raise InputError(where, f"{_shown(value)}, expected a gain, a curve [[value, amount], ...] or {{gain, curve}}")


def _curve(where: str, value: object) -> Curve:
    if not isinstance(value, list) or not all(map(_is_knot, value)):
        raise InputError(where, f"{_shown(value)}, expected a curve [[value, amount], ...]")
    return tuple((_float(where, at), _float(where, amount)) for at, amount in value)


def _is_knot(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _text(where: str, content: dict[str, Any], key: str, otherwise: str) -> str:
    text = content.get(key, otherwise)
    if not isinstance(text, str):
        raise InputError(f"{where} -> {key}", f"{_shown(text)}, expected a text")
    return text


def _check_keys(where: str, content: dict[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            raise InputError(f"{where} -> {key[:60]}", f"unknown key, expected some of {', '.join(known)}")


def _is_number(value: object) -> bool:
    return type(value) in (int, float)


def _float(where: str, value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        raise InputError(where, "a number beyond any float, expected a smaller one") from None


def _shown(value: object) -> str:
    try:
        return str(value)[:40]
    except ValueError:  # an integer of more digits than Python prints
        return "a number beyond reason"
