"""Timecodes HH:MM:SS:FF[.sub] as frames."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.processors.animate.performance import middle

_CODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}):(\d{1,3}(?:\.\d*)?)")
_DAY = 24 * 3600


def frames_of(where: Sequence[str], codes: Sequence[str], fps: float) -> FloatArray:
    """(k,) frames of timecodes since the first one; midnight may lie between.

    :param where: the trail to each
    :param fps: frames per second; of 29.97 and 59.94 a timecode counts 30 and 60
    :raises InputError: no timecode, or frames that show another rate
    """
    nominal = round(fps)
    parsed = [_parsed(one, code, nominal) for one, code in zip(where, codes, strict=True)]
    seconds, frames = np.array([one[0] for one in parsed]), np.array([one[1] for one in parsed])
    seconds = seconds + _DAY * np.concatenate([[0], np.cumsum(np.diff(seconds) < -_DAY / 2)])
    found = seconds * nominal + frames
    highest = int(frames.max())
    if len(np.unique(seconds)) > 2 and highest + 1.5 * max(middle(np.diff(found)), 1.0) < nominal:
        shown = f"frames 0 to {highest} in every second"
        raise InputError(where[0], f"{shown}, expected up to {nominal - 1} at {fps:g} fps (--fps {highest + 1}?)")
    return np.asarray(found - found[0])


def _parsed(where: str, code: str, nominal: int) -> tuple[int, float]:
    """Seconds of the day, and the frame."""
    match = _CODE.fullmatch(code.strip())
    if match is None:
        raise InputError(where, f"timecode '{code[:40]}', expected HH:MM:SS:FF or HH:MM:SS:FF.sub")
    hours, minutes, seconds = (int(one) for one in match.groups()[:3])
    frame = float(match.group(4))
    if hours > 23 or minutes > 59 or seconds > 59:
        raise InputError(where, f"timecode '{code[:40]}', expected a time of day")
    if frame >= nominal:
        what = f"frame {int(frame)} of a second, expected 0 to {nominal - 1} at {nominal} fps (--fps?)"
        raise InputError(where, what)
    return hours * 3600 + minutes * 60 + seconds, frame
