"""What a captured clip holds, whatever its file: rows of values when they were taken, made frames at a steady rate.

A reader gives a `Take`; `performance_of` finds out its rate and the units of its weights and angles by what they hold,
fills what was not tracked, and says what it did.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.rig.conventions import meaning, shape_key, spelling

FPS = 60.0  # of a file that does not say
RATES = (1.0, 1000.0)  # frames per second that a file may have
LARGEST = 1e12  # number that a file may hold
LATEST = 1e19  # time that it may hold: nanoseconds since 1970 are 1.8e18
MOST_FRAMES = 1 << 19  # 2.4 hours at 60 fps
MOST_NAMES = 4096  # as many as a table has columns
MOST_VALUES = 1 << 26  # 128 names for as long
PARTS = ("Head", "LeftEye", "RightEye")
ANGLES: Mapping[str, str] = {  # key -> name
    shape_key(part + angle): part + angle for part in PARTS for angle in ("Yaw", "Pitch", "Roll")
}
_USUAL_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 90.0, 100.0, 120.0, 24e3 / 1001, 30e3 / 1001, 60e3 / 1001)
_ON_FRAME = 0.01  # frames that a time may be off
_TICK = 1e-3  # seconds that a clock of whole milliseconds may be off: some cut the rest off
_NO_TURN = math.pi  # no head turns farther, recordings wrap there; 1 % for rounding
_NO_EYE_TURN = 1.3  # radians, 75 degrees: eyes reach 55
_FAR_TURN = 1.2  # radians of yaw or pitch, 69 degrees: trackers lose faces there; a phone on its side rolls by 1.6
_PERCENT = (10.0, 150.0)  # largest weight of a clip in percent
_EXAGGERATED = 2.0  # weights beyond are of another unit, or of a caricature
_DAY = 24 * 3600
_CODE = re.compile(r"(\d{1,2})([:;])(\d{1,2})[:;](\d{1,2})([:;.,])(\d{1,6})(?:\.(\d*))?")
_CLOCK_UNITS = {"ms": 1e-3, "msec": 1e-3, "millis": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "microseconds": 1e-6}
_CLOCK_UNITS |= {"ns": 1e-9, "nanoseconds": 1e-9, "ticks": 1e-7}  # ticks as .NET has them
_CLOCK_UNITS |= {"seconds": 1.0, "secs": 1.0, "sec": 1.0}  # last: milliseconds end so too


@dataclass(kw_only=True)
class Take:
    """Rows as a file holds them.

    :param form: what wrote it, for people
    :param where: the trail to each row
    :param values: (k, names), NaN where a value was not tracked
    :param frames: (k,) when each row is, ascending, in frames of `rate`; or `seconds`; neither: a row is a frame
    :param rate: frames per second, None where the file does not say
    :param slack: frames that a time may be off through rounding
    :param radians: of a reader that knows its angles
    """

    form: str
    where: Sequence[str]
    names: Sequence[str]
    values: FloatArray
    frames: FloatArray | None = None
    seconds: FloatArray | None = None
    rate: float | None = None
    slack: float = _ON_FRAME
    radians: bool = False
    notes: list[str] = field(default_factory=list)  # how it was read
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Performance:
    """Frames at a steady rate."""

    where: str  # the file, for messages
    fps: float
    names: tuple[str, ...]
    values: FloatArray  # (T, names)
    filled: int = 0  # frames that the file lacks
    read_as: str = ""  # what the file was found to be, and how it was read
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
        check_count(self.where, count, len(self.names))
        return replace(self, fps=fps, values=_interpolated(np.arange(count) / fps, self.seconds, self.values))


def angle_of(name: str) -> str | None:
    """The name of `ANGLES` that a column's name means, in any spelling; None for all others."""
    return ANGLES.get(shape_key(name), ANGLES.get(spelling(name)))


def turn_angles(rotations: FloatArray) -> FloatArray:
    """(T, 3) yaw, pitch and roll in radians of (T, 3, 3) rotations, Y up: ``R = Ry(-yaw) Rx(pitch) Rz(-roll)``."""
    R = np.asarray(rotations, dtype=np.float64)
    yaw, roll = -np.arctan2(R[:, 0, 2], R[:, 2, 2]), -np.arctan2(R[:, 1, 0], R[:, 1, 1])
    return np.stack([yaw, np.arcsin(np.clip(-R[:, 1, 2], -1.0, 1.0)), roll], axis=1)


def performance_of(path: Path, take: Take, fps: float | None, angles: str) -> Performance:
    """A performance of rows that may be late, missing or twice.

    :param fps: frames per second, None: what the take says or shows, or 60
    :param angles: `rad`, `deg`, or `auto`: by what they hold
    :raises InputError: no rows, time that runs backwards, a name twice, weights of no known unit, or too many frames
    """
    where = str(path)
    if not len(take.values):
        raise InputError(where, "no frames, expected some")
    check_count(where, len(take.values), len(take.names))
    twice = next((name for name, times in Counter(take.names).items() if times > 1), None)
    if twice is not None:
        raise InputError(where, f"'{twice[:60]}' twice, expected each name once")
    _in_usual_units(where, take, angles)
    frames, rate = _frames(take, fps)
    back = np.flatnonzero(np.diff(frames) < 0)
    if len(back):
        raise InputError(take.where[back[0] + 1], "is before the frame above it, expected ascending times")
    last = np.append(np.diff(frames) > 0, True)  # of rows at one time the last
    if not last.all():
        take.warnings.append(f"{int((~last).sum())} frames have the time of the frame before: left out")
    frames, values = frames[last] - frames[last][0], take.values[last]
    # the median: a gap of many frames would lengthen the mean
    step = max(1.0, float(np.rint(middle(np.diff(frames)))))
    count = int(frames[-1] / step + 0.5) + 1
    check_count(where, count, len(take.names))
    off = np.abs(frames / step - np.rint(frames / step)).max() * step
    if off > take.slack:
        take.warnings.append(f"frames are up to {off:.2g} of a frame off whole ones: interpolated")
    else:
        frames = np.rint(frames / step) * step
    lost, names, columns = _filled(where, take, frames, values, np.arange(count) * step)
    fps = rate / step
    turning = sum(1 for name in names if angle_of(name))
    held = f"{len(names) - turning} weights" + (f" and {turning} turns" if turning else "")
    return Performance(
        where=where,
        fps=fps,
        names=names,
        values=np.stack(columns, axis=1),
        filled=count - len(frames) + lost,
        read_as=", ".join([f"{take.form}: {held}, {fps:.6g} fps", *take.notes]),
        warnings=tuple(take.warnings),
    )


def _filled(
    where: str, take: Take, frames: FloatArray, values: FloatArray, at: FloatArray
) -> tuple[int, tuple[str, ...], list[FloatArray]]:
    """How many rows hold nothing, the names with values, and each of these at the frames `at`, straight between rows.

    :param values: (k, names) of the rows at `frames`, NaN where not tracked; turns are unwrapped in place
    :raises InputError: no values at all
    """
    # before interpolation: half way between 179 and -179 degrees is 180, not 0
    for i in (i for i, name in enumerate(take.names) if angle_of(name)):
        seen = np.isfinite(values[:, i])
        values[seen, i] = np.unwrap(values[seen, i])
    tracked = np.isfinite(values)
    lost = int((~np.atleast_1d(tracked.any(axis=1))).sum())
    kept = np.atleast_1d(tracked.any(axis=0))
    if not kept.any():
        raise InputError(where, "a face in none of its frames, expected some")
    if not kept.all():
        empty = [name for name, some in zip(take.names, kept, strict=True) if not some]
        take.warnings.append(f"no values of {first_names(empty, 4)}: left out")
    partly = int((~tracked[:, kept]).any(axis=1).sum()) - lost
    if partly:
        take.notes.append(f"{partly} frames with values that were not tracked, filled")
    columns = [np.interp(at, frames[tracked[:, i]], values[tracked[:, i], i]) for i in np.flatnonzero(kept)]
    return lost, tuple(name for name, some in zip(take.names, kept, strict=True) if some), columns


def _in_usual_units(where: str, take: Take, angles: str) -> None:
    """Make weights fractions and angles radians.

    :raises InputError: weights that are neither fractions nor percent
    """
    turns = np.array([bool(angle_of(name)) for name in take.names])
    peaks = np.nanmax(np.abs(take.values), axis=0, initial=0.0, where=np.isfinite(take.values))
    if turns.any() and not take.radians:
        nods = np.array([(angle_of(name) or "").endswith(("Yaw", "Pitch")) for name in take.names])
        eyes = np.array([(angle_of(name) or "").find("Eye") > 0 for name in take.names])
        most, eye = float(peaks[turns].max()), float(peaks[eyes].max(initial=0.0))
        degrees = angles == "deg" or (angles == "auto" and (most > 1.01 * _NO_TURN or eye > _NO_EYE_TURN))
        if degrees:
            take.values[:, turns] *= math.pi / 180
            found = "" if angles == "deg" else f" (up to {most:g}: no radians)"
            take.notes.append(f"turns in degrees{found}")
        elif most > 1.01 * _NO_TURN:
            take.warnings.append(f"turns up to {most:g} radians, {most / (2 * math.pi):.1f} times round: --angles deg?")
        elif angles == "auto" and (far := float(peaks[nods].max(initial=0.0))) > _FAR_TURN:
            what = f"turns up to {far:g}, taken as radians, which are {math.degrees(far):.0f} degrees"
            take.warnings.append(f"{what}: --angles deg or rad says which")
    # by names of faces, where there are: a column of rates or shares beside says nothing of their unit
    known = np.array([meaning(name) is not None for name in take.names]) & (peaks > 0)
    shown = ~turns & known if (~turns & known).any() else ~turns
    weights = np.abs(take.values[:, shown])
    weights = weights[np.isfinite(weights) & (weights > 0)]
    most = float(weights.max(initial=0.0))
    # by shares: one bad value of a tracker must not make all others a hundredth
    beyond = float((weights > 1.5).mean()) if len(weights) else 0.0
    if _PERCENT[0] < most <= _PERCENT[1] and beyond > 0.2:
        take.values[:, ~turns] /= 100
        take.notes.append(f"weights in percent (up to {most:g})")
    # sliders of a face's own are in no unit that others have: 3 may be three times their maximum
    elif most > _PERCENT[0] or (most > _EXAGGERATED and beyond > 0.5 and known.sum() > 3):
        name = take.names[int(np.flatnonzero(shown)[np.argmax(peaks[shown])])]
        raise InputError(where, f"{name[:60]} up to {most:g}, expected weights from 0 to 1, or percent")
    elif most > _EXAGGERATED:
        take.warnings.append(f"weights up to {most:g}, taken as they are: 1 is the whole shape")


def _frames(take: Take, fps: float | None) -> tuple[FloatArray, float]:
    """(k,) when the rows of a take are, in frames of a rate, and that rate.

    :raises InputError: a time that is not finite
    """
    if take.seconds is None and not take.rate and not fps:
        held = "no times" if take.frames is None else "numbers of frames alone"
        take.notes.append(f"{FPS:g} fps taken, as it holds {held} (--fps)")
    if take.frames is not None:
        return take.frames, take.rate or fps or FPS
    if take.seconds is None:
        return np.arange(len(take.values), dtype=np.float64), fps or take.rate or FPS
    if not np.isfinite(take.seconds).all():
        raise InputError(take.where[int(np.argmin(np.isfinite(take.seconds)))], "a time that is not finite")
    # from the first: clocks of captures start anywhere
    seconds = take.seconds - take.seconds[0]
    rounded = np.abs(seconds * 1e3 - np.rint(seconds * 1e3)).max() < 1e-6
    rate = fps or take.rate or rate_of(seconds, _TICK if rounded else 0.0)
    take.slack = max(take.slack, 1.01 * _TICK * rate) if rounded else take.slack
    return seconds * rate, rate


def rate_of(seconds: FloatArray, tick: float = 0.0) -> float:
    """Frames per second of frames at (k,) `seconds`, the first at 0, each off by up to `tick`.

    A usual rate on whose frames they are; else that of the mean step, if they are on frames of it; else a whole number
    near that of the median step, between whose frames they lie.
    """
    step = middle(np.diff(seconds)) if len(seconds) > 1 else 0.0
    if step <= 0:
        return FPS
    counted = float(np.rint(np.diff(seconds) / step).sum())
    mean = min(counted / float(seconds[-1]), RATES[1]) if seconds[-1] > 0 and counted else FPS
    for rate in (*sorted(_USUAL_RATES, key=lambda usual: abs(usual - mean)), mean):
        frames = seconds * rate
        if np.abs(frames - np.rint(frames)).max() < _ON_FRAME + 1.01 * tick * rate and abs(rate - mean) < 0.1 * mean:
            return rate
    rate = min(1.0 / step, RATES[1])
    return float(round(rate)) if abs(rate - round(rate)) < 0.01 * rate else rate


def clock_seconds(where: str, name: str, values: FloatArray, take_notes: list[str]) -> FloatArray:
    """(k,) times of a clock in seconds: by the unit in its name, else by how far apart frames are.

    :raises InputError: steps that are those of no unit
    """
    word = re.sub(r"[^a-z]", "", name.casefold())
    named = next((unit for unit in _CLOCK_UNITS if word.endswith(unit)), None)
    step = middle(np.diff(values)) if len(values) > 1 else 0.0
    if named is not None:
        return np.asarray(values * _CLOCK_UNITS[named])
    for unit, scale, low, high in (
        ("", 1.0, 0.0, 2.0),
        ("milliseconds", 1e-3, 2.0, 500.0),
        ("microseconds", 1e-6, 4e3, 5e5),  # less is a millisecond clock of keys that are seconds apart
        ("nanoseconds", 1e-9, 1e6, 5e8),
    ):
        if low <= step <= high:
            if unit:
                take_notes.append(f"'{name[:40]}' in {unit} (steps of {step:g})")
            return np.asarray(values * scale)
    raise InputError(where, f"'{name[:60]}' in steps of {step:g}, expected seconds, milli-, micro- or nanoseconds")


def read_timecodes(take: Take, codes: Sequence[str], fps: float | None) -> None:
    """Give a take the times of its rows by timecodes; midnight may lie between.

    ``HH:MM:SS:FF[.sub]`` counts frames, ``HH:MM:SS;FF`` those of drop frame: 29.97 or 59.94 a second, 2 or 4 numbers
    left out each minute but every tenth (SMPTE ST 12-1). ``HH:MM:SS:MMM`` and ``HH:MM:SS.fraction`` are times.

    :param fps: frames per second; of 29.97 and 59.94 a timecode counts 30 and 60. None: what the codes show, or 60
    :raises InputError: no timecode, or frames that show another rate
    """
    parsed = []
    for trail, code in zip(take.where, codes, strict=True):
        match = _CODE.fullmatch(code.strip())
        fraction = match is not None and match.group(5) in ".,"
        if match is None or (fraction and (len(match.group(6)) < 3 or match.group(7) is not None)):
            raise InputError(trail, f"timecode '{code[:40]}', expected HH:MM:SS:FF or HH:MM:SS:FF.sub")
        hour, minute, second = int(match.group(1)), int(match.group(3)), int(match.group(4))
        if hour > 23 or minute > 59 or second > 59:
            raise InputError(trail, f"timecode '{code[:40]}', expected a time of day")
        ends = float(f"0.{match.group(6)}") if fraction else float(f"{match.group(6)}.{match.group(7) or 0}")
        parsed.append((hour * 3600 + minute * 60 + second, ends, fraction, match.group(5) == ";"))
    seconds, last = np.array([one[0] for one in parsed], dtype=np.float64), np.array([one[1] for one in parsed])
    seconds = seconds + _DAY * np.concatenate([[0], np.cumsum(np.diff(seconds) < -_DAY / 2)])
    highest = int(last.max())
    if any(one[2] for one in parsed):
        whole = next((i for i, one in enumerate(parsed) if not one[2]), None)
        if whole is not None:
            raise InputError(take.where[whole], f"timecode '{codes[whole][:40]}', expected a fraction, as others have")
        take.seconds = seconds + last
        return
    if 130 <= highest < 1000 and highest >= (
        fps or 0
    ):  # no camera has as many frames a second as a clip of half a second has milliseconds
        take.seconds = np.asarray(seconds + np.floor(last) / 1000)
        take.notes.append("timecodes end in milliseconds")
        return
    drop = any(one[3] for one in parsed)
    shown = None if fps else (30.0 if highest < 30 else 60.0) if drop else _shown_rate(seconds, last)
    nominal = round(fps or shown or FPS)
    over = np.flatnonzero(last >= nominal)
    if len(over):
        what = f"frame {int(last[over[0]])} of a second, expected 0 to {nominal - 1} at {nominal} fps (--fps?)"
        raise InputError(take.where[over[0]], what)
    counted = seconds * nominal + last
    if drop:
        minutes = np.floor(seconds / 60)
        counted -= round(nominal / 15) * (minutes - np.floor(minutes / 10))
    # frame numbers that never come near the rate are of a lower one: at the wrong rate a clip would stutter each second
    if len(np.unique(seconds)) > 2 and highest + 1.5 * max(middle(np.diff(counted)), 1.0) < nominal:
        lower = f"frames 0 to {highest} in every second"
        expected = f"expected up to {nominal - 1} at {fps or FPS:g} fps (--fps {highest + 1}?)"
        raise InputError(take.where[0], f"{lower}, {expected}")
    take.frames = np.asarray(counted - counted[0])
    take.rate = fps or (nominal * 1000 / 1001 if drop else float(nominal))
    if shown is not None and (drop or shown != FPS):
        take.notes.append("drop frame timecodes" if drop else f"timecodes of {nominal} frames a second")


def _shown_rate(seconds: FloatArray, last: FloatArray) -> float | None:
    """The usual rate at which frames go on in steps of one length where a second ends; None for none.

    Frames that are missing there make it seem lower, so the highest counts.
    """
    step = middle(np.diff(last)[np.diff(seconds) == 0])
    ends = np.flatnonzero(np.diff(seconds) == 1)
    left = float(np.rint(last[ends] - last[ends + 1] + step).max(initial=0.0))
    return left if left in _USUAL_RATES and left > last.max() else None


def middle(steps: FloatArray) -> float:
    """The lower median; 1 of none."""
    return float(np.sort(steps)[(len(steps) - 1) // 2]) if len(steps) else 1.0


def check_count(where: str, count: int, names: int) -> None:
    """:raises InputError: more frames, names or values than a clip may have"""
    if names > MOST_NAMES:
        raise InputError(where, f"{names} names, expected at most {MOST_NAMES}")
    if count > MOST_FRAMES:
        raise InputError(where, f"{count} frames with those that are missing, expected at most {MOST_FRAMES}")
    if count * names > MOST_VALUES:
        raise InputError(where, f"{count} frames of {names} names, expected at most {MOST_VALUES} values")


def _interpolated(at: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)
