"""Records of a plan's tasks, a line of JSON each, kept as they end: a killed run loses none that ended."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.core.locks import locked

Record = dict[str, Any]  # task, status, words, key, reads, writes, report, ... (`facepipe.farm.work`)
FILE = "tasks.jsonl"
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
        try:
            self._file.write(_line(record))
            self._file.flush()
        except OSError as error:
            raise InputError(self._path, f"can't be written: {error.strerror or error}") from error


@contextlib.contextmanager
def ledger_in(folder: Path) -> Iterator[Ledger]:
    """The ledger of a plan's state folder, which one run at a time has.

    :raises InputError: another run has it, it is a link, or it can't be read or written
    """
    path = folder / FILE
    if path.is_symlink():
        raise InputError(path, "is a link, expected a file")
    with locked(path, patience=0.0):
        lines, records = _read(path)
        if lines > _SLACK * len(records) + 100 or not _ends_whole(path):
            _write(path, records.values())
        try:
            file = path.open("ab")
        except OSError as error:
            raise InputError(path, f"can't be written: {error.strerror or error}") from error
        with file:
            yield Ledger(path, file, records)
            os.fsync(file.fileno())


def _read(path: Path) -> tuple[int, dict[str, Record]]:
    """The number of lines, and the last record of each task; lines that are cut off or damaged are passed over."""
    records: dict[str, Record] = {}
    lines = 0
    try:
        with path.open("rb") as file:
            for line in file:
                lines += 1
                with contextlib.suppress(ValueError, RecursionError):
                    record = json.loads(line)
                    if _is_record(record):
                        records[record["task"]] = record
    except FileNotFoundError:
        pass
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error
    return lines, records


def _is_record(record: Any) -> bool:
    """Whether a line is what a run writes: a state folder may come from elsewhere."""
    if not isinstance(record, dict) or not all(isinstance(record.get(key), str) for key in ("task", "status")):
        return False
    reads, writes = record.get("reads", {}), record.get("writes", {})
    if not isinstance(reads, dict) or not isinstance(writes, dict) or not isinstance(record.get("report", {}), dict):
        return False
    states = [*reads.values(), *(write[0] for write in writes.values() if isinstance(write, list) and len(write) == 2)]
    whole = "key" in record and "reads" in record and "writes" in record
    return all(isinstance(one, list) for one in (*states, *writes.values())) and (whole or record["status"] == "failed")


def _ends_whole(path: Path) -> bool:
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
    return True  # empty, or none


def _write(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.writelines(map(_line, records))


def _line(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, separators=(",", ":"), sort_keys=True).encode() + b"\n"
