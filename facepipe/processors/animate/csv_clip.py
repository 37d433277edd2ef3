"""Performances in CSV: Live Link Face's, and tables of shape names.

    Timecode,BlendShapeCount,EyeBlinkLeft, ... ,TongueOut,HeadYaw, ... ,RightEyeRoll     61 values a frame
    Timecode | Time | Frame,jawOpen,mouthSmileLeft                                       or none of these: a row a frame

Columns of Live Link Face may stand in any order and case. Source of its names: recordings that the app wrote.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.processors.animate.angles import ANGLES
from facepipe.processors.animate.performance import FPS, LARGEST, Performance, in_radians, middle, steady
from facepipe.processors.animate.timecode import frames_of
from facepipe.rig.conventions import ARKIT_SHAPES, shape_key

MOST_BYTES = 1 << 29
_COUNT = "blendshapecount"
_CLOCKS = ("timecode", "time", "timestamp", "seconds", "frame")


class _Table(NamedTuple):
    path: Path
    header: list[str]
    lines: list[tuple[int, list[str]]]  # number in the file, cells

    def where(self, line: int) -> str:
        """The trail to a line."""
        return f"{self.path} -> line {line}"


def read_csv(path: Path, fps: float | None, *, degrees: bool) -> Performance:
    """:raises InputError: no CSV with a header, missing columns, cells that are no numbers, or a wrong clock"""
    table = _table(path)
    keys = [shape_key(name) for name in table.header]
    if _COUNT in keys:
        table = _live_link(table, keys)
        keys = [shape_key(name) for name in table.header]
    clock = next((keys.index(name) for name in _CLOCKS if name in keys), None)
    columns = [i for i, key in enumerate(keys) if i != clock and key != _COUNT and key not in _CLOCKS]
    if not columns:
        raise InputError(table.where(1), "no columns of weights, expected names of shapes")
    values = _numbers(table, columns)
    rate, frames = _clock(table, clock, fps)
    names = [table.header[i] for i in columns]
    return steady(str(path), frames, rate, names, in_radians(values, names, degrees=degrees))


def _table(path: Path) -> _Table:
    try:
        text = read_bytes(path, MOST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 (byte {error.start}), expected CSV") from None
    first = text.lstrip().partition("\n")[0]
    delimiter = max(",;\t", key=first.count)
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cells)]
    except csv.Error as error:
        raise InputError(path, f"is not CSV ({str(error)[:120]})") from None
    if len(lines) < 2:
        raise InputError(path, f"{len(lines)} lines, expected a header and frames")
    header = lines[0][1]
    while header and not header[-1]:  # a comma at the end
        header.pop()
    number = next((name for name in header if _is_number(name)), None)
    if number is not None or not all(header):
        found = "a column without name" if number is None else f"'{number[:40]}'"
        raise InputError(f"{path} -> line {lines[0][0]}", f"{found}, expected a header of names")
    return _Table(path, header, lines[1:])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _live_link(table: _Table, keys: Sequence[str]) -> _Table:
    """The table without frames in which no face was seen.

    :raises InputError: columns that Live Link Face always writes are missing
    """
    wanted = {shape_key(name): name for name in ("timecode", *sorted(ARKIT_SHAPES), *ANGLES.values())}
    missing = [name for key, name in wanted.items() if key not in keys]
    if missing:
        some = ", ".join(missing[:4]) + (" ..." if len(missing) > 4 else "")
        what = f"{len(missing)} columns of Live Link Face are missing ({some}), expected all {len(wanted) + 1}"
        raise InputError(table.where(1), what)
    place = list(keys).index(_COUNT)
    seen = [(line, cells) for line, cells in table.lines if len(cells) <= place or cells[place] != "0"]
    if not seen:
        raise InputError(table.path, "a face in none of its frames, expected some")
    return table._replace(lines=seen)


def _numbers(table: _Table, columns: Sequence[int]) -> FloatArray:
    values = np.empty((len(table.lines), len(columns)))
    for row, (line, cells) in enumerate(table.lines):
        try:
            values[row] = [float(cells[i]) for i in columns]
        except (ValueError, IndexError):
            raise _bad_cell(table, line, cells, columns) from None
    sound = np.abs(values) <= LARGEST  # nor NaN
    if not sound.all():
        line, cells = table.lines[int(np.flatnonzero(~sound.all(axis=1))[0])]
        raise _bad_cell(table, line, cells, columns)
    return values


def _bad_cell(table: _Table, line: int, cells: Sequence[str], columns: Sequence[int]) -> InputError:
    if len(cells) < len(table.header):
        return InputError(table.where(line), f"{len(cells)} cells, expected {len(table.header)}")
    wrong = next(i for i in columns if not _is_number(cells[i]) or not abs(float(cells[i])) <= LARGEST)
    return InputError(table.where(line), f"{table.header[wrong][:60]} '{cells[wrong][:40]}', expected a number")


def _clock(table: _Table, column: int | None, fps: float | None) -> tuple[float, FloatArray]:
    """Frames per second, and the time of each line in frames."""
    if column is None:
        return fps or FPS, np.arange(len(table.lines), dtype=np.float64)
    name = shape_key(table.header[column])
    if name == "timecode":
        short = next((line for line, cells in table.lines if len(cells) <= column), None)
        if short is not None:
            raise InputError(table.where(short), "no timecode, expected HH:MM:SS:FF")
        where = [table.where(line) for line, _ in table.lines]
        return fps or FPS, frames_of(where, [cells[column] for _, cells in table.lines], fps or FPS)
    times = _numbers(table, [column])[:, 0]
    if name == "frame":
        return fps or FPS, times - times[0]
    rate = fps or rate_of(times)
    return rate, (times - times[0]) * rate


def rate_of(seconds: FloatArray) -> float:
    """Frames per second of frames at `seconds`: a whole number where it is nearly one."""
    step = middle(np.diff(seconds)) if len(seconds) > 1 else 0.0
    if step <= 0:
        return FPS
    rate = min(max(1.0 / step, 1.0), 1000.0)
    return float(round(rate)) if abs(rate - round(rate)) < 0.01 * rate else rate
