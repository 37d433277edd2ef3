"""Performances from files."""

from __future__ import annotations

from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.processors.animate.csv_clip import read_csv
from facepipe.processors.animate.json_clip import read_json_clip
from facepipe.processors.animate.performance import Performance

_READERS = {".csv": read_csv, ".json": read_json_clip}


def read_performance(path: Path, fps: float | None = None, *, degrees: bool = False) -> Performance:
    """What a CSV or JSON file holds.

    :param fps: frames per second; None: what the file says, or 60
    :param degrees: of its angles; else radians
    :raises InputError: another suffix, or a file that can't be used
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, f"suffix '{path.suffix}', expected one of {' '.join(_READERS)}")
    return reader(path, fps, degrees=degrees)
