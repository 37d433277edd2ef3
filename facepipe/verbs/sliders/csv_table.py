"""Tables of sliders in CSV: a row per slider and target, or the matrix of gamma = W^T alpha + b.

    slider,target,gain,curve,group,min,max,default,mirror       target and gain are needed, the others optional
    noseWidth,nostrilLeft:tx,0.3,,nose,-1,1,0,
    noseWidth,jawOpen,0.5,-1:0 0:0 1:1,,,,,

    slider,nostrilLeft:tx,jaw*:s,jawOpen,group,min,max          columns named so are settings, all others are targets
    noseWidth,0.3,0.1,0,nose,-1,1
    b,0.05,0,0,,,

What has a colon is JOINT:CHANNEL, all else a shape; both may be patterns. Cells are parted by commas, semicolons (then
a comma may stand for the decimal point) or tabs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reading import read_csv
from facepipe.parts import Curve
from facepipe.verbs.sliders.slider_table import MOST_BYTES, Bias, Drive, SliderRule, SliderTable, check_number

_LIST = ("slider", "target", "gain")
_SETTINGS = ("group", "min", "max", "default", "mirror")
_BIAS = ("b", "bias")
_NUMERIC = set("0123456789+-.,eE: ")

Row = tuple[str, Mapping[str, str]]  # the trail to it, column -> text; columns without a text are left out


def read(path: Path) -> SliderTable:
    """:raises InputError: not readable, no CSV, or neither form"""
    header, rows = _rows(path)
    others = [name for name in header if name not in (*_LIST, *_SETTINGS, "curve")]
    if any(":" in name for name in others) or not set(_LIST[1:]) & set(header):
        return _matrix(path, header, rows)
    missing = [name for name in _LIST if name not in header]
    if missing or others:
        found = f"no column '{missing[0]}'" if missing else f"column '{others[0][:40]}'"
        expected = f"{', '.join(_LIST)}, and curve, {', '.join(_SETTINGS)} where needed"
        raise InputError(f"{path} -> line 1", f"{found}, expected columns {expected}")
    return _list(path, rows)


def _list(path: Path, rows: Sequence[Row]) -> SliderTable:
    drives: dict[str, list[Drive]] = {}
    settings: dict[str, dict[str, str]] = {}
    places: dict[str, str] = {}
    for where, row in rows:
        name, target = _needed(where, row, "slider"), _needed(where, row, "target")
        curve = _curve(where, row["curve"]) if "curve" in row else None
        gain = _number(where, "gain", _needed(where, row, "gain"))
        driven = drives.setdefault(name, [])
        if target in {one.target for one in driven}:
            raise InputError(where, f"target '{target[:60]}' of slider '{name[:60]}' twice, expected each once")
        driven.append(Drive(target=target, gain=gain, curve=curve, where=f"{where} -> {name[:60]}"))
        _merge(where, settings.setdefault(name, {}), row)
        places.setdefault(name, where)
    rules = [_rule(f"{places[name]} -> {name[:60]}", name, settings[name], drives[name]) for name in drives]
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
        rules.append(_rule(where, name, {key: row[key] for key in _SETTINGS if key in row}, drives))
    return SliderTable(rules=tuple(rules), bias=tuple(bias), where=str(path))


def _rule(where: str, name: str, settings: Mapping[str, str], drives: Sequence[Drive]) -> SliderRule:
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


def _merge(where: str, settings: dict[str, str], row: Mapping[str, str]) -> None:
    for key in _SETTINGS:
        if key in row and settings.setdefault(key, row[key]) != row[key]:
            what = f"{key} '{row[key][:40]}', and '{settings[key][:40]}' in a row above, expected the same (or nothing)"
            raise InputError(where, what)


def _rows(path: Path) -> tuple[list[str], list[Row]]:
    delimiter, lines = read_csv(path, MOST_BYTES)
    if delimiter == ";":
        lines = [(number, [_with_points(cell) for cell in cells]) for number, cells in lines]
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
        row = {name: cell for name, cell in zip(header, cells, strict=False) if cell}
        rows.append((f"{path} -> line {number}", row))
    return header, rows


def _with_points(cell: str) -> str:
    """A number with a point for its decimal comma; other texts as they are."""
    return cell.replace(",", ".") if set(cell) <= _NUMERIC else cell


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


def _curve(where: str, text: str) -> Curve:
    pairs = [knot.partition(":") for knot in text.split()]
    return tuple((_number(where, "knot", at), _number(where, "knot", amount)) for at, _, amount in pairs)
