"""Clips in files, found out by what they hold: tables here, JSON in `clip_json`, USD and glTF in `clip_stage`.

    Timecode,BlendShapeCount,EyeBlinkLeft, ... ,TongueOut,HeadYaw, ... ,RightEyeRoll     Live Link Face
    ,timeCode,blendShapes.EyeBlinkLeft, ...                                              Audio2Face
    frame,timestamp_ms,eyeBlinkLeft, ...                                                 MediaPipe
    Timecode | Time | Frame,jawOpen,mouthSmileLeft                                       or none of these: a row a frame

Columns stand in any order and case; decimals have a point or a comma. Source of Live Link Face's names: recordings that
the app wrote; of Audio2Face's: docs.nvidia.com/ace, the sample client of Audio2Face-3D.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.reading import read_csv
from facepipe.rig.conventions import ARKIT_SHAPES, shape_key, spelling
from facepipe.verbs.animate.performance import (
    LARGEST,
    LATEST,
    Performance,
    Take,
    clock_seconds,
    performance_of,
    read_timecodes,
)

TABLES = (".csv", ".tsv", ".txt")
DOCUMENTS = (".json", ".jsonl", ".ndjson")
STAGES = (".usd", ".usda", ".usdc", ".usdz", ".glb", ".gltf", ".vrm", ".fbx")
MOST_BYTES = 1 << 29
_COUNT = "blendshapecount"
_TIME = re.compile(
    r"(time|timestamp|timesec|seconds|secs?)(ms|msec|millis|milliseconds|us|ns|s|sec|seconds)?|millis(econds)?"
)
_NUMBER = ("frame", "frames", "framenumber", "frameindex", "frameid", "index", "unnamed0")


def read_performance(path: Path, fps: float | None = None, *, angles: str = "auto") -> Performance:
    """What a file holds of a captured clip.

    :param fps: frames per second; None: what the file says or shows, or 60
    :param angles: of its turns: `rad`, `deg`, or `auto`: by what they hold
    :raises InputError: another suffix, or a file that can't be used
    """
    suffix = path.suffix.lower()
    if suffix in STAGES:
        from facepipe.verbs.animate.clip_stage import read_stage_clip

        return performance_of(path, read_stage_clip(path), fps, angles)
    if suffix in DOCUMENTS:
        from facepipe.verbs.animate.clip_json import read_clip_json

        return performance_of(path, read_clip_json(path, MOST_BYTES, fps), fps, angles)
    if suffix in TABLES:
        return performance_of(path, _read_table(path, fps), fps, angles)
    raise InputError(path, f"suffix '{path.suffix}', expected one of {' '.join((*TABLES, *DOCUMENTS, *STAGES))}")


class _Table(NamedTuple):
    path: Path
    header: list[str]
    lines: list[tuple[int, list[str]]]  # number in the file, cells

    def where(self, line: int) -> str:
        """The trail to a line."""
        return f"{self.path} -> line {line}"


def _read_table(path: Path, fps: float | None) -> Take:
    """:raises InputError: no CSV with a header, no weights, cells that are no numbers, or a wrong clock"""
    _, lines = read_csv(path, MOST_BYTES)
    if len(lines) < 2:
        raise InputError(path, f"{len(lines)} lines, expected a header and frames")
    header = lines[0][1]
    while header and not header[-1]:  # a comma at the end
        header.pop()
    if header and not header[0]:  # the index that pandas writes
        header[0] = "index"
    number = next((name for name in header if _is_number(name)), None)
    if number is not None or not all(header):
        found = "a column without name" if number is None else f"'{number[:40]}'"
        raise InputError(f"{path} -> line {lines[0][0]}", f"{found}, expected a header of names")
    table = _Table(path, header, lines[1:])
    longer = next((one for one in table.lines if any(one[1][len(header) :])), None)
    if longer is not None:  # a decimal comma between commas would move every value after it
        raise InputError(table.where(longer[0]), f"{len(longer[1])} cells, expected {len(header)}, as the header has")
    keys = [re.sub(r"[^a-z0-9]", "", name.casefold()) for name in header]
    live_link = _COUNT in keys
    codes = [i for i, name in enumerate(keys) if name == "timecode"]
    times = [i for i, name in enumerate(keys) if _TIME.fullmatch(name)]
    numbers = [i for i, name in enumerate(keys) if name in _NUMBER]
    if codes and _is_number(table.lines[0][1][codes[0]] if len(table.lines[0][1]) > codes[0] else ""):
        times, codes = [codes[0], *times], []  # Audio2Face's timeCode is in seconds
    clocks = {*codes, *times, *numbers}
    columns = [i for i, key in enumerate(keys) if i not in clocks and key != _COUNT]
    if not columns:
        raise InputError(table.where(1), "no columns of weights, expected names of shapes")
    where = [table.where(line) for line, _ in table.lines]
    names = [header[i] for i in columns]
    take = Take(form=_form(names, live_link=live_link), where=where, names=names, values=_numbers(table, columns))
    if live_link:
        # the frames stay, without values: a clip whose first ones have no face would begin late, against its sound
        count = keys.index(_COUNT)
        take.values[[len(cells) > count and cells[count] == "0" for _, cells in table.lines]] = np.nan
        missing = sorted(ARKIT_SHAPES - {name for name in ARKIT_SHAPES if shape_key(name) in map(shape_key, names)})
        if missing:
            take.notes.append(f"without {first_names(missing, 4)}")
    if codes:
        short = next((line for line, cells in table.lines if len(cells) <= codes[0]), None)
        if short is not None:
            raise InputError(table.where(short), "no timecode, expected HH:MM:SS:FF")
        read_timecodes(take, [cells[codes[0]] for _, cells in table.lines], fps)
    elif times:
        clock = _numbers(table, times[:1], clock=True)[:, 0]
        take.seconds = clock_seconds(str(path), header[times[0]], clock, take.notes)
    elif numbers:
        counted = _numbers(table, numbers[:1], clock=True)[:, 0]
        take.frames = counted - counted[0]
    return take


def _form(names: Sequence[str], *, live_link: bool) -> str:
    if live_link:
        return "Live Link Face"
    if all(name.casefold().startswith("blendshapes.") for name in names):
        return "Audio2Face table"
    known = {shape_key(name) for name in ARKIT_SHAPES}
    return "table of ARKit shapes" if sum(spelling(name) in known for name in names) > len(known) / 2 else "table"


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _numbers(table: _Table, columns: Sequence[int], *, clock: bool = False) -> FloatArray:
    """(k, columns) values; NaN for empty cells, in which nothing was tracked."""
    values = np.empty((len(table.lines), len(columns)))
    most = max(columns)
    for row, (line, cells) in enumerate(table.lines):
        try:
            values[row] = [float(cells[i]) for i in columns]
        except (ValueError, IndexError):
            if len(cells) <= most and (any(cells[i] for i in columns if i < len(cells)) or clock):
                raise _bad_cell(table, line, cells, columns) from None
            for place, i in enumerate(columns):
                text = cells[i].replace(",", ".") if i < len(cells) else ""
                if not _is_number(text or "0") or (not text and clock):
                    raise _bad_cell(table, line, cells, columns) from None
                values[row, place] = float(text) if text else np.nan
    lost = np.isnan(values)
    for row in np.flatnonzero(lost.any(axis=1)).tolist():  # NaN that the file spells out is a mistake, as text is
        line, cells = table.lines[row]
        if any(cells[i] for place, i in enumerate(columns) if lost[row, place] and i < len(cells)):
            raise _bad_cell(table, line, cells, columns)
    sound = lost | (np.abs(values) <= (LATEST if clock else LARGEST))
    if not sound.all():
        line, cells = table.lines[int(np.flatnonzero(~sound.all(axis=1))[0])]
        raise _bad_cell(table, line, cells, columns)
    return values


def _bad_cell(table: _Table, line: int, cells: Sequence[str], columns: Sequence[int]) -> InputError:
    if len(cells) < len(table.header):
        return InputError(table.where(line), f"{len(cells)} cells, expected {len(table.header)}")
    texts = {i: cells[i].replace(",", ".") for i in columns}
    wrong = next(i for i, text in texts.items() if not _is_number(text) or not abs(float(text)) <= LARGEST)
    return InputError(table.where(line), f"{table.header[wrong][:60]} '{cells[wrong][:40]}', expected a number")
