"""Records of a plan's tasks, a line of JSON each, kept as they end: a killed run loses none that ended."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError, system_errors
from facepipe.core.locks import locked
from facepipe.core.reading import check_input, check_regular, check_values

Record = dict[str, Any]  # task, status, words, key, reads, writes, report, ... (`facepipe.tasks.program`)
FILE = "tasks.jsonl"
STATUSES = (MADE, KEPT, CACHED, FAILED) = ("made", "kept", "cached", "failed")
_MOST_LINE = 1 << 24  # bytes: reports are brief, but a step once for all reads the results of 200,000 faces
_MOST_BYTES = 8 << 30  # six million tasks have 4 GB, and more until they are written anew
_MOST_DIGITS = 100  # of an integer: from 309 on it is no float
_SLACK = 1.5  # lines for each task before the file is written anew


class Ledger:
    """The last record of each task."""

    def __init__(self, path: Path, file: IO[bytes], records: dict[str, Record]) -> None:
        self._path, self._file, self.records = path, file, records

    def add(self, record: Record) -> None:
        """Keep a record before anything else happens.

        :raises InputError: it can't be written
        """
        self.records[record["task"]] = record
        with system_errors(self._path, "can't be written"):
            self._file.write(_line(record))
            self._file.flush()


@contextlib.contextmanager
def ledger_in(folder: Path) -> Iterator[Ledger]:
    """The ledger of a plan's state folder, which one run at a time has.

    :raises InputError: another run has it, it is a link, or it can't be read or written
    """
    path = folder / FILE
    if path.is_symlink():
        raise InputError(path, "is a link, expected a file")
    check_input(path)
    with locked(path, patience=0.0):
        records: dict[str, Record] = {}  # the last of each task; lines that are cut off or damaged are passed over
        lines, line, is_shared = 0, b"\n", False
        with system_errors(path, "can't be read"):
            if path.exists():
                check_regular(path, _MOST_BYTES)
                with path.open("rb") as former:
                    while piece := former.readline(_MOST_LINE):
                        line = piece
                        lines += line.endswith(b"\n")
                        record = parsed(line)
                        if record is not None and is_record(record):
                            records[record["task"]] = record
                is_shared = path.stat().st_nlink > 1  # a hard link: what is added would be added to another's file
        if lines > _SLACK * len(records) + 100 or not line.endswith(b"\n") or is_shared:
            with replacing(path) as temporary, temporary.open("wb") as anew:
                anew.writelines(map(_line, records.values()))
        with system_errors(path, "can't be written"):
            file = path.open("ab")
        with file:
            yield Ledger(path, file, records)
            os.fsync(file.fileno())


def parsed(data: bytes) -> Any:
    """The value of a text of JSON, None where it is none, has too many values, or a number that a report can't have."""
    if data.startswith(b"\0"):  # of a file with holes: no text to parse
        return None
    try:
        check_values("", data)
        return json.loads(data, parse_constant=_finite, parse_float=_finite, parse_int=_short)
    except (ValueError, RecursionError, InputError):
        return None


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _short(text: str) -> int:
    if len(text.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(text[:_MOST_DIGITS])
    return int(text)


def is_record(record: Any) -> bool:
    """Whether a value is what a run writes of a task: a state folder may come from elsewhere."""
    if not is_outcome(record) or not {"task", "status"} <= record.keys() or record["status"] not in STATUSES:
        return False
    known = {"error"} if record["status"] == FAILED else {"key", "reads", "writes", "seconds"}
    return bool(known <= record.keys())


def is_outcome(record: Any) -> bool:
    """Whether what a value says of a task has the kinds that it should."""
    return isinstance(record, dict) and all(
        key not in record or is_kind(record[key]) for key, is_kind in _KINDS.items()
    )


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable()


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 1e15


def _is_state(value: Any) -> bool:
    """Bytes, and a mark of the version: a time, or a text of a store."""
    return isinstance(value, list) and len(value) == 2 and _is_number(value[0]) and isinstance(value[1], int | str)


def _are_names(value: Any) -> bool:
    """Keys that files can be called by."""
    try:
        return isinstance(value, dict) and all(map(os.fsencode, value))
    except UnicodeEncodeError:  # half a surrogate pair
        return False


_KINDS: Mapping[str, Callable[[Any], bool]] = {
    "task": _is_text,
    "status": _is_text,
    "words": lambda value: isinstance(value, list) and all(isinstance(one, str) for one in value),
    "version": _is_text,
    "key": _is_text,
    "verb": _is_text,
    "error": _is_text,
    "reads": lambda value: _are_names(value) and all(map(_is_state, value.values())),
    # the state of each file, None where a cache has it, and its digest
    "writes": lambda value: (
        _are_names(value)
        and all(isinstance(one, list) and len(one) == 2 for one in value.values())
        and all((state is None or _is_state(state)) and _is_text(own) for state, own in value.values())
    ),
    "report": lambda value: isinstance(value, dict),
    "attribution": lambda value: isinstance(value, list) and all(map(_is_text, value)),
    "seconds": _is_number,
    "peak_mb": lambda value: value is None or _is_number(value),
    "lost": _is_number,
    "missed": lambda value: isinstance(value, bool),
    "passing": lambda value: isinstance(value, bool),
}


def _line(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, separators=(",", ":"), sort_keys=True).encode() + b"\n"
