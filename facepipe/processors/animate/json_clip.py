"""Performances in JSON: frames of ARKit weights, in the forms that tools write.

    [{"time": 0.0, "blendShapes": {"jawOpen": 0.2, ...}, "HeadYaw": 0.1}, ...]     or {"frames": [...], "fps": 60}
    {"exportFps": 60, "facsNames": ["eyeBlinkLeft", ...], "weightMat": [[0.0, ...], ...]}

Weights of a frame are an object, or a list of {"categoryName" | "name", "score" | "value"}; they may also stand in the
frame itself. Seconds are "time", "timestamp" or "seconds", a timecode "timecode"; else a frame follows the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.reading import read_json
from facepipe.processors.animate.angles import angle_of
from facepipe.processors.animate.csv_clip import MOST_BYTES, rate_of
from facepipe.processors.animate.performance import FPS, LARGEST, Performance, in_radians, steady
from facepipe.processors.animate.timecode import frames_of

_WEIGHTS = ("blendshapes", "weights", "shapes")
_SECONDS = ("time", "timestamp", "seconds")
_RATES = ("fps", "exportfps", "framerate")
_NAMES = ("facsnames", "names", "blendshapenames")
_MATRIX = ("weightmat", "values")
_EXPECTED = "a list of frames, or an object with frames, or with facsNames and weightMat"


def read_json_clip(path: Path, fps: float | None, *, degrees: bool) -> Performance:
    """:raises InputError: not JSON, another form, other names in some frames, or values that are no numbers"""
    content = read_json(path, MOST_BYTES)
    top = _keyed(content) if isinstance(content, Mapping) else {}
    own = _first(top, _RATES)
    rate = fps or (None if own is None else _number(f"{path} -> fps", own))
    if rate is not None and not 1.0 <= rate <= 1000.0:
        raise InputError(f"{path} -> fps", f"{rate:g}, expected 1 to 1000")
    names, rows = _first(top, _NAMES), _first(top, _MATRIX)
    if names is not None and rows is not None:
        frames: Any = _zipped(path, names, rows)
    else:
        frames = content if isinstance(content, list) else top.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(one, Mapping) for one in frames):
        raise InputError(path, f"another form, expected {_EXPECTED}")
    return _performance(path, [_keyed(one) for one in frames], frames, rate, degrees=degrees)


def _performance(
    path: Path, keyed: list[dict[str, Any]], frames: list[Any], rate: float | None, *, degrees: bool
) -> Performance:
    where = [f"{path} -> frame {number}" for number in range(1, len(frames) + 1)]
    found = [_weights(*one) for one in zip(where, keyed, frames, strict=True)]
    names = list(dict.fromkeys(name for one in found for name in one))
    if not names:
        raise InputError(path, "no weights, expected names of shapes with numbers")
    for one, own in zip(where, found, strict=True):
        if len(own) != len(names):
            missing = next(name for name in names if name not in own)
            raise InputError(one, f"no '{missing[:60]}', expected the {len(names)} names of the other frames")
    rows = np.array([[own[name] for name in names] for own in found])
    values = in_radians(rows, names, degrees=degrees)
    if "timecode" in keyed[0]:
        times = frames_of(where, [str(one.get("timecode")) for one in keyed], rate or FPS)
        return steady(str(path), times, rate or FPS, names, values)
    clock = next((name for name in _SECONDS if name in keyed[0]), None)
    if clock is None:
        return steady(str(path), np.arange(len(frames)) * 1.0, rate or FPS, names, values)
    seconds = np.array([_number(f"{one} -> {clock}", own.get(clock)) for one, own in zip(where, keyed, strict=True)])
    rate = rate or rate_of(seconds)
    return steady(str(path), (seconds - seconds[0]) * rate, rate, names, values)


def _weights(where: str, keyed: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, float]:
    """Name -> number of one frame."""
    held = _first(keyed, _WEIGHTS)
    if isinstance(held, list):
        rows = [_keyed(one) if isinstance(one, Mapping) else {} for one in held]
        held = {str(_first(one, ("categoryname", "name"))): _first(one, ("score", "value")) for one in rows}
    skipped = (*_WEIGHTS, *_SECONDS, "timecode", "frame", "index")
    beside = {name: value for name, value in frame.items() if name.casefold() not in skipped}
    if held is not None:
        beside = {name: value for name, value in beside.items() if angle_of(name)}
        if not isinstance(held, Mapping):
            raise InputError(where, "weights of another form, expected names with numbers")
    return {str(name): _number(f"{where} -> {name}", value) for name, value in {**(held or {}), **beside}.items()}


def _zipped(path: Path, names: Any, rows: Any) -> list[Any]:
    if not isinstance(names, list) or not isinstance(rows, list):
        raise InputError(path, f"another form, expected {_EXPECTED}")
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != len(names):
            found = f"{len(row)} weights" if isinstance(row, list) else "no list"
            raise InputError(f"{path} -> frame {number}", f"{found}, expected {len(names)} weights")
    return [{"weights": dict(zip(map(str, names), row, strict=True))} for row in rows]


def _keyed(value: Mapping[str, Any]) -> dict[str, Any]:
    return {str(name).casefold(): one for name, one in value.items()}


def _first(keyed: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((keyed[name] for name in names if name in keyed), None)


def _number(where: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -LARGEST <= value <= LARGEST:
        raise InputError(where, f"{str(value)[:40]}, expected a number")
    return float(value)
