"""A performance: weights and angles by name, frame by frame, before it meets a face."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.rig.conventions import shape_key

FPS = 60.0  # of a file that does not say
LARGEST = 1e12  # number that a file may hold; times in seconds since 1970 are below
MOST_FRAMES = 1 << 19  # 2.4 hours at 60 fps
_ON_FRAME = 0.01  # frames that a time may be off
PARTS = ("Head", "LeftEye", "RightEye")
ANGLES: Mapping[str, str] = {  # key -> name
    shape_key(part + angle): part + angle for part in PARTS for angle in ("Yaw", "Pitch", "Roll")
}


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
