"""Performances from files: CSV of Live Link Face, tables of shape names, and JSON in the forms that tools write.

    Timecode,BlendShapeCount,EyeBlinkLeft, ... ,TongueOut,HeadYaw, ... ,RightEyeRoll     61 values a frame
    Timecode | Time | Frame,jawOpen,mouthSmileLeft                                       or none of these: a row a frame
    [{"time": 0.0, "blendShapes": {"jawOpen": 0.2, ...}, "HeadYaw": 0.1}, ...]     or {"frames": [...], "fps": 60}
    {"exportFps": 60, "facsNames": ["eyeBlinkLeft", ...], "weightMat": [[0.0, ...], ...]}

Columns of Live Link Face may stand in any order and case. Source of its names: recordings that the app wrote. In JSON,
weights of a frame are an object, or a list of {"categoryName" | "name", "score" | "value"}; they may also stand in the
frame itself. Seconds are "time", "timestamp" or "seconds", a timecode "timecode"; else a frame follows the other.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.reading import read_csv, read_json
from facepipe.rig.conventions import ARKIT_SHAPES, shape_key

FPS = 60.0  # of a file that does not say
LARGEST = 1e12  # number that a file may hold; times in seconds since 1970 are below
MOST_FRAMES = 1 << 19  # 2.4 hours at 60 fps
_ON_FRAME = 0.01  # frames that a time may be off
PARTS = ("Head", "LeftEye", "RightEye")
ANGLES: Mapping[str, str] = {  # key -> name
    shape_key(part + angle): part + angle for part in PARTS for angle in ("Yaw", "Pitch", "Roll")
}
_SUFFIXES = (".csv", ".json")
_MOST_BYTES = 1 << 29
_COUNT = "blendshapecount"
_CLOCKS = ("timecode", "time", "timestamp", "seconds", "frame")
_WEIGHTS = ("blendshapes", "weights", "shapes")
_SECONDS = ("time", "timestamp", "seconds")
_RATES = ("fps", "exportfps", "framerate")
_NAMES = ("facsnames", "names", "blendshapenames")
_MATRIX = ("weightmat", "values")
_EXPECTED = "a list of frames, or an object with frames, or with facsNames and weightMat"
_CODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}):(\d{1,3}(?:\.\d*)?)")
_DAY = 24 * 3600


@dataclass(frozen=True, kw_only=True)
class Performance:
    """Frames at a steady rate."""

    where: str  # the file, for messages
    fps: float
    names: tuple[str, ...]
    values: FloatArray  # (T, names)
    filled: int = 0  # frames that the file lacks
    warnings: tuple[str, ...] = ()

    @property
    def seconds(self) -> FloatArray:
        """(T,) times, the first is 0."""
        return np.arange(len(self.values)) / self.fps

    def cut(self, start: float | None, end: float | None) -> Performance:
        """The frames from `start` to `end`, in seconds.

        :raises InputError: none is left
        """
        low, high = start or 0.0, np.inf if end is None else end
        near = _ON_FRAME / self.fps
        kept = (self.seconds >= low - near) & (self.seconds <= high + near)
        if not kept.any():
            span = f"{low:g} s on" if end is None else f"{low:g} to {high:g} s"
            raise InputError(self.where, f"nothing from {span}, expected some of its {self.seconds[-1]:g} s")
        return replace(self, values=self.values[kept])

    def at_rate(self, fps: float) -> Performance:
        """The same at other frames per second, straight between frames.

        :raises InputError: too many frames
        """
        if fps == self.fps:
            return self
        count = int(self.seconds[-1] * fps + _ON_FRAME) + 1
        _check_count(self.where, count)
        return replace(self, fps=fps, values=_interpolated(np.arange(count) / fps, self.seconds, self.values))


def in_radians(values: FloatArray, names: Sequence[str], *, degrees: bool) -> FloatArray:
    """(k, names) values whose angles were `degrees` or are radians already."""
    if not degrees:
        return values
    return np.asarray(values * [math.pi / 180 if angle_of(name) else 1.0 for name in names])


def steady(where: str, frames: FloatArray, fps: float, names: Sequence[str], values: FloatArray) -> Performance:
    """A performance of rows that may be late, missing or twice.

    :param frames: (k,) when each row is, in frames of `fps`, ascending
    :param values: (k, names); angles in radians, which may jump by a whole turn
    :raises InputError: no rows, time that runs backwards, a name twice, or too many frames
    """
    if not len(values):
        raise InputError(where, "no frames, expected some")
    twice = next((name for name, times in Counter(names).items() if times > 1), None)
    if twice is not None:
        raise InputError(where, f"'{twice[:60]}' twice, expected each name once")
    back = np.flatnonzero(np.diff(frames) < 0)
    if len(back):
        raise InputError(f"{where} -> frame {back[0] + 2}", "is before the frame above it, expected ascending times")
    last = np.append(np.diff(frames) > 0, True)  # of rows at one time the last
    warnings = [] if last.all() else [f"{int((~last).sum())} frames have the time of the frame before: left out"]
    frames, values = frames[last] - frames[last][0], values[last]
    # the median: a gap of many frames would lengthen the mean
    step = max(1.0, float(np.rint(middle(np.diff(frames)))))
    count = int(frames[-1] / step + 0.5) + 1
    _check_count(where, count)
    grid = np.arange(count) * step
    off = np.abs(frames / step - np.rint(frames / step)).max() * step
    if off > _ON_FRAME:
        warnings.append(f"frames are up to {off:.2g} of a frame off whole ones: interpolated")
    else:
        frames = np.rint(frames / step) * step
    turns = [i for i, name in enumerate(names) if angle_of(name)]
    values = np.array(values)
    # before interpolation: half way between 179 and -179 degrees is 180, not 0
    values[:, turns] = np.unwrap(values[:, turns], axis=0)
    return Performance(
        where=where,
        fps=fps / step,
        names=tuple(names),
        values=_interpolated(grid, frames, values),
        filled=count - len(frames),
        warnings=tuple(warnings),
    )


def middle(steps: FloatArray) -> float:
    """The lower median; 1 of none."""
    return float(np.sort(steps)[(len(steps) - 1) // 2]) if len(steps) else 1.0


def _check_count(where: str, count: int) -> None:
    if count > MOST_FRAMES:
        raise InputError(where, f"{count} frames with those that are missing, expected at most {MOST_FRAMES}")


def _interpolated(at: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)


def angle_of(name: str) -> str | None:
    """The name of `ANGLES` that a column's name means, in any spelling; None for all others."""
    return ANGLES.get(shape_key(name))


def read_performance(path: Path, fps: float | None = None, *, degrees: bool = False) -> Performance:
    """What a CSV or JSON file holds.

    :param fps: frames per second; None: what the file says, or 60
    :param degrees: of its angles; else radians
    :raises InputError: another suffix, or a file that can't be used
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(path, f"suffix '{path.suffix}', expected one of {' '.join(_SUFFIXES)}")
    return (_read_csv if suffix == ".csv" else _read_json)(path, fps, degrees=degrees)


class _Table(NamedTuple):
    path: Path
    header: list[str]
    lines: list[tuple[int, list[str]]]  # number in the file, cells

    def where(self, line: int) -> str:
        """The trail to a line."""
        return f"{self.path} -> line {line}"


def _read_csv(path: Path, fps: float | None, *, degrees: bool) -> Performance:
    """:raises InputError: no CSV with a header, missing columns, cells that are no numbers, or a wrong clock"""
    _, lines = read_csv(path, _MOST_BYTES)
    if len(lines) < 2:
        raise InputError(path, f"{len(lines)} lines, expected a header and frames")
    header = lines[0][1]
    while header and not header[-1]:  # a comma at the end
        header.pop()
    number = next((name for name in header if _is_number(name)), None)
    if number is not None or not all(header):
        found = "a column without name" if number is None else f"'{number[:40]}'"
        raise InputError(f"{path} -> line {lines[0][0]}", f"{found}, expected a header of names")
    table = _Table(path, header, lines[1:])
    keys = [shape_key(name) for name in table.header]
    if _COUNT in keys:
        # the table without frames in which no face was seen
        wanted = {shape_key(name): name for name in ("timecode", *sorted(ARKIT_SHAPES), *ANGLES.values())}
        missing = [name for key, name in wanted.items() if key not in keys]
        if missing:
            some = first_names(missing, 4)
            what = f"{len(missing)} columns of Live Link Face are missing ({some}), expected all {len(wanted) + 1}"
            raise InputError(table.where(1), what)
        place = list(keys).index(_COUNT)
        seen = [(line, cells) for line, cells in table.lines if len(cells) <= place or cells[place] != "0"]
        if not seen:
            raise InputError(table.path, "a face in none of its frames, expected some")
        table = table._replace(lines=seen)
        keys = [shape_key(name) for name in table.header]
    clock = next((keys.index(name) for name in _CLOCKS if name in keys), None)
    columns = [i for i, key in enumerate(keys) if i != clock and key != _COUNT and key not in _CLOCKS]
    if not columns:
        raise InputError(table.where(1), "no columns of weights, expected names of shapes")
    values = _numbers(table, columns)
    rate = fps or FPS
    frames: FloatArray = np.arange(len(table.lines), dtype=np.float64)
    if clock is not None and keys[clock] == "timecode":
        short = next((line for line, cells in table.lines if len(cells) <= clock), None)
        if short is not None:
            raise InputError(table.where(short), "no timecode, expected HH:MM:SS:FF")
        where = [table.where(line) for line, _ in table.lines]
        frames = _timecode_frames(where, [cells[clock] for _, cells in table.lines], rate)
    elif clock is not None:
        times = _numbers(table, [clock])[:, 0]
        # a column Frame counts frames, the others seconds
        rate = rate if keys[clock] == "frame" else fps or _rate_of(times)
        frames = (times - times[0]) * (1.0 if keys[clock] == "frame" else rate)
    names = [table.header[i] for i in columns]
    return steady(str(path), frames, rate, names, in_radians(values, names, degrees=degrees))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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


def _rate_of(seconds: FloatArray) -> float:
    """Frames per second of frames at `seconds`: a whole number where it is nearly one."""
    step = middle(np.diff(seconds)) if len(seconds) > 1 else 0.0
    if step <= 0:
        return FPS
    rate = min(max(1.0 / step, 1.0), 1000.0)
    return float(round(rate)) if abs(rate - round(rate)) < 0.01 * rate else rate


def _read_json(path: Path, fps: float | None, *, degrees: bool) -> Performance:
    """:raises InputError: not JSON, another form, other names in some frames, or values that are no numbers"""
    content = read_json(path, _MOST_BYTES)
    top = _keyed(content) if isinstance(content, Mapping) else {}
    own = _first(top, _RATES)
    rate = fps or (None if own is None else _number(f"{path} -> fps", own))
    if rate is not None and not 1.0 <= rate <= 1000.0:
        raise InputError(f"{path} -> fps", f"{rate:g}, expected 1 to 1000")
    names, rows = _first(top, _NAMES), _first(top, _MATRIX)
    if names is not None and rows is not None:
        if not isinstance(names, list) or not isinstance(rows, list):
            raise InputError(path, f"another form, expected {_EXPECTED}")
        for number, row in enumerate(rows, 1):
            if not isinstance(row, list) or len(row) != len(names):
                found = f"{len(row)} weights" if isinstance(row, list) else "no list"
                raise InputError(f"{path} -> frame {number}", f"{found}, expected {len(names)} weights")
        frames: Any = [{"weights": dict(zip(map(str, names), row, strict=True))} for row in rows]
    else:
        frames = content if isinstance(content, list) else top.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, Mapping) for frame in frames):
        raise InputError(path, f"another form, expected {_EXPECTED}")
    return _performance(path, [_keyed(frame) for frame in frames], frames, rate, degrees=degrees)


def _performance(
    path: Path, keyed: list[dict[str, Any]], frames: list[Any], rate: float | None, *, degrees: bool
) -> Performance:
    where = [f"{path} -> frame {number}" for number in range(1, len(frames) + 1)]
    weights = []
    skipped = (*_WEIGHTS, *_SECONDS, "timecode", "frame", "index")
    for trail, own, frame in zip(where, keyed, frames, strict=True):
        held = _first(own, _WEIGHTS)
        if isinstance(held, list):
            listed = [_keyed(one) if isinstance(one, Mapping) else {} for one in held]
            held = {str(_first(one, ("categoryname", "name"))): _first(one, ("score", "value")) for one in listed}
        beside = {name: value for name, value in frame.items() if name.casefold() not in skipped}
        if held is not None:
            beside = {name: value for name, value in beside.items() if angle_of(name)}
            if not isinstance(held, Mapping):
                raise InputError(trail, "weights of another form, expected names with numbers")
        numbers = {**(held or {}), **beside}
        weights.append({str(name): _number(f"{trail} -> {name}", value) for name, value in numbers.items()})
    names = list(dict.fromkeys(name for weight in weights for name in weight))
    if not names:
        raise InputError(path, "no weights, expected names of shapes with numbers")
    for trail, frame_weights in zip(where, weights, strict=True):
        if len(frame_weights) != len(names):
            missing = next(name for name in names if name not in frame_weights)
            raise InputError(trail, f"no '{missing[:60]}', expected the {len(names)} names of the other frames")
    rows = np.array([[own[name] for name in names] for own in weights])
    values = in_radians(rows, names, degrees=degrees)
    if "timecode" in keyed[0]:
        times = _timecode_frames(where, [str(one.get("timecode")) for one in keyed], rate or FPS)
        return steady(str(path), times, rate or FPS, names, values)
    clock = next((name for name in _SECONDS if name in keyed[0]), None)
    if clock is None:
        return steady(str(path), np.arange(len(frames)) * 1.0, rate or FPS, names, values)
    seconds = np.array([_number(f"{one} -> {clock}", own.get(clock)) for one, own in zip(where, keyed, strict=True)])
    rate = rate or _rate_of(seconds)
    # from the first: clocks of captures start anywhere
    return steady(str(path), (seconds - seconds[0]) * rate, rate, names, values)


def _keyed(value: Mapping[str, Any]) -> dict[str, Any]:
    return {str(name).casefold(): one for name, one in value.items()}


def _first(keyed: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((keyed[name] for name in names if name in keyed), None)


def _number(where: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -LARGEST <= value <= LARGEST:
        raise InputError(where, f"{str(value)[:40]}, expected a number")
    return float(value)


def _timecode_frames(where: Sequence[str], codes: Sequence[str], fps: float) -> FloatArray:
    """(k,) frames of timecodes since the first one; midnight may lie between.

    :param where: the trail to each
    :param fps: frames per second; of 29.97 and 59.94 a timecode counts 30 and 60
    :raises InputError: no timecode, or frames that show another rate
    """
    nominal = round(fps)
    parsed = []
    for trail, code in zip(where, codes, strict=True):
        match = _CODE.fullmatch(code.strip())
        if match is None:
            raise InputError(trail, f"timecode '{code[:40]}', expected HH:MM:SS:FF or HH:MM:SS:FF.sub")
        hour, minute, second = (int(group) for group in match.groups()[:3])
        frame = float(match.group(4))
        if hour > 23 or minute > 59 or second > 59:
            raise InputError(trail, f"timecode '{code[:40]}', expected a time of day")
        if frame >= nominal:
            what = f"frame {int(frame)} of a second, expected 0 to {nominal - 1} at {nominal} fps (--fps?)"
            raise InputError(trail, what)
        parsed.append((hour * 3600 + minute * 60 + second, frame))
    seconds, frames = np.array([one[0] for one in parsed]), np.array([one[1] for one in parsed])
    seconds = seconds + _DAY * np.concatenate([[0], np.cumsum(np.diff(seconds) < -_DAY / 2)])
    counted = seconds * nominal + frames
    # frame numbers that never come near the rate are of a lower one: at the wrong rate a clip would stutter each second
    highest = int(frames.max())
    if len(np.unique(seconds)) > 2 and highest + 1.5 * max(middle(np.diff(counted)), 1.0) < nominal:
        shown = f"frames 0 to {highest} in every second"
        raise InputError(where[0], f"{shown}, expected up to {nominal - 1} at {fps:g} fps (--fps {highest + 1}?)")
    return np.asarray(counted - counted[0])
