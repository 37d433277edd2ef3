"""Tables of names: JSON objects ``{"old": "new"}``, and CSV files of two columns, old and new."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes, read_json_object

MAX_BYTES = 1 << 24
_HEADER = ("old", "new")


def read_rename_table(path: Path) -> dict[str, str]:
    """Old name -> new one.

    :raises InputError: another suffix, no such table, a name that is empty or holds a NUL, an old name twice, or two
        with one new name
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _checked(path, [(old, new, f"'{old[:60]}'") for old, new in read_json_object(path, MAX_BYTES).items()])
    if suffix == ".csv":
        return _checked(path, _csv_rows(path))
    raise InputError(path, f"suffix '{path.suffix}', expected .json or .csv with old and new names")


def _csv_rows(path: Path) -> list[tuple[str, str, str]]:
    try:
        text = read_bytes(path, MAX_BYTES).decode("utf-8-sig")
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"no CSV in UTF-8 ({error}), expected two columns, old and new") from None
    found = []
    for number, row in enumerate(rows, 1):
        if len(row) != 2 and row:
            raise InputError(f"{path} -> row {number}", f"{len(row)} columns, expected two: old,new")
        if row and not (number == 1 and tuple(one.strip().lower() for one in row) == _HEADER):
            found.append((row[0], row[1], f"row {number}"))
    return found


def _checked(path: Path, rows: Iterable[tuple[str, object, str]]) -> dict[str, str]:
    names: dict[str, str] = {}
    owners: dict[str, str] = {}
    for old, new, at in rows:
        where = f"{path} -> {at}"
        if not isinstance(new, str) or not old or not new or "\0" in old + new:
            raise InputError(where, "no pair of names, expected two texts that are not empty")
        if old in names:
            raise InputError(where, f"'{old[:60]}' once more, expected each old name once")
        if new in owners:
            raise InputError(where, f"'{new[:60]}' is the new name of '{owners[new][:60]}' too, expected two names")
        names[old] = new
        owners[new] = old
    if not names:
        raise InputError(path, "no names, expected pairs of old and new")
    return names
