"""Tables of faces: a row each, of a glob, a CSV file, rows in TOML, or a range of numbers."""

from __future__ import annotations

import csv
import fnmatch
import io
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from facepipe.core.errors import InputError
from facepipe.core.names import check_keys, file_name
from facepipe.core.policy.paths import check_copied, checked, is_url, placed, trust
from facepipe.core.reading import read_bytes
from facepipe.farm.remote import Store

_MOST_BYTES = 1 << 27  # of a CSV file
_MOST_ROWS = 1_000_000
_MOST_COLUMNS = 4096
_MOST_VALUES = 3_000_000  # of a CSV file: a byte of it can become an object of a hundred
_MOST_ENTRIES = 1_000_000  # of folders that a glob looks at
_MOST_PATTERN = 4096  # characters
_KINDS = ("glob", "csv", "rows", "range")


class Row(NamedTuple):
    """A face of the table."""

    name: str
    values: Mapping[str, str]  # column -> what braces are replaced by


def read_table(where: str, folder: Path, table: Mapping[str, Any], *, typed: bool = False) -> tuple[Row, ...]:
    """The rows of one of ``glob = "heads/*.glb"`` (column face), ``csv = "faces.csv"`` (columns as its header says),
    ``rows = [{ name = "ada", seed = 7 }]``, ``range = { seed = [1, 500] }`` (both ends are in it).

    A row's `name` is its column of that name, else of its file (with folders where two are called alike), else its
    number.

    :param typed: the caller has typed the glob, which may lie anywhere; else what is read lies below the roots
    :raises InputError: none or two of these, one that can't be read, no row, or two rows of one name
    """
    kinds = [kind for kind in _KINDS if kind in table]
    check_keys(where, table, _KINDS)
    if len(kinds) != 1:
        raise InputError(where, f"expected one of {', '.join(_KINDS)}")
    kind, said = kinds[0], table[kinds[0]]
    place = f"{where}.{kind}"
    if kind == "glob":
        columns: Iterable[dict[str, str]] = _of_glob(place, folder, said, typed=typed)
    elif kind == "csv":
        columns = _of_csv(place, folder, said)
    elif kind == "rows":
        fine = isinstance(said, list) and all(isinstance(one, dict) and one.keys() == said[0].keys() for one in said)
        if not fine or not all(isinstance(value, str | int | float) for one in said for value in one.values()):
            raise InputError(place, "expected a list of rows with the same columns, texts and numbers")
        columns = ({str(key): str(value) for key, value in one.items()} for one in said)
    else:
        ends = next(iter(said.values())) if isinstance(said, dict) and len(said) == 1 else None
        if not isinstance(ends, list) or len(ends) != 2 or not all(type(end) is int for end in ends):
            raise InputError(place, "expected a column with its first and last number, like { seed = [1, 500] }")
        first, last = ends
        if not 0 <= last - first < _MOST_ROWS:
            what = f"from {first} to {last}, expected at least one and at most {_MOST_ROWS:,} numbers"
            raise InputError(place, what)
        (column,) = said
        columns = ({column: str(number)} for number in range(first, last + 1))
    rows = []
    for number, values in enumerate(columns, 1):
        own = values.get("name") or (Path(values["face"]).stem if "face" in values else "")
        name = file_name(own) if own else str(number)
        rows.append(Row(name, {**values, "name": name}))
    if not rows:
        raise InputError(where, "no face, expected at least one")
    return tuple(rows)


def _of_glob(where: str, folder: Path, pattern: Any, *, typed: bool) -> list[dict[str, str]]:
    if not isinstance(pattern, str):
        raise InputError(where, f"{str(pattern)[:40]}, expected a pattern like heads/*.glb")
    if is_url(pattern):
        checked(re.split(r"[*?[]", pattern)[0].rpartition("/")[0], trust().urls)
        files = [checked(one, trust().urls) for one in Store(pattern).matching(pattern)]
    else:
        files = sorted({*_matching(where, folder, pattern, typed=typed)})
    if len(files) > _MOST_ROWS:  # of a store
        raise InputError(where, f"more than {_MOST_ROWS:,} files are called like {pattern[:80]}")
    if not files:
        raise InputError(where, f"no file is called like {pattern[:80]}")
    faces = [Path(one.rpartition("://")[2]) for one in files]
    stems = Counter(face.stem for face in faces)
    alone = [face.stem if stems[face.stem] == 1 else "_".join(face.with_suffix("").parts) for face in faces]
    return [{"face": one.replace(os.sep, "/"), "name": name} for one, name in zip(files, alone, strict=True)]


def _matching(where: str, folder: Path, pattern: str, *, typed: bool) -> Iterator[str]:
    """The files that are called like a pattern, relative to a folder as it is.

    ``**`` is any folders; hidden names need a dot in the pattern. Links to folders are not followed below the first
    wildcard: four of them to their own folder would never end.

    :param typed: by the caller; else all must lie below the roots of a plan in the folder
    """
    if len(pattern) > _MOST_PATTERN:
        raise InputError(where, f"{pattern[:40]}... is {len(pattern):,} characters long")
    parts = pattern.replace(os.sep, "/").split("/")
    wild = next((number for number, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts) - 1)
    start, rest = "/".join(parts[:wild]), [one for one in parts[wild:] if one not in ("", ".")]
    if ".." in rest:
        raise InputError(where, f"{pattern[:80]} has .. behind a wildcard, expected it before")
    if pattern.startswith("/") or start.endswith(":"):  # a drive of Windows
        start = f"{start}/"
    if not typed:
        check_copied(where, folder / start, folder / "plan")
    for number, (name, matches) in enumerate(_below(folder, start, rest)):
        if number == _MOST_ENTRIES:
            raise InputError(where, f"{pattern[:80]} looks at more than {_MOST_ENTRIES:,} files and folders")
        if matches:
            yield name


def _below(folder: Path, start: str, parts: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """What lies below a folder as far as parts of a pattern lead, and whether it matches them all.

    Each folder is looked at once, for all places in the pattern that it is reached at: with a ``**`` after another,
    ways through the pattern are more than folders by far.
    """
    parts = [*parts, "*"] if parts[-1:] == ["**"] else parts or [""]
    fits = [re.compile(fnmatch.translate(os.path.normcase(part))).match for part in parts]
    todo = [(start, {0})]
    while todo:
        place, at = todo.pop()
        for number in sorted(at):
            while parts[number] == "**":  # no folder at all
                number += 1
                at.add(number)
        try:
            with os.scandir(folder / place) as entries:
                found = [(one.name, one.is_dir(follow_symlinks=False)) for one in entries]
        except (OSError, ValueError):  # a folder that others took away, or may not be seen
            continue
        for name, is_folder in found:
            own = f"{place}/{name}".replace("//", "/") if place else name
            plain, hidden, deeper, matches = os.path.normcase(name), name.startswith("."), set(), False
            for number in at:
                if hidden and not parts[number].startswith("."):
                    continue
                if parts[number] == "**":
                    deeper.add(number)
                elif fits[number](plain):
                    matches |= number + 1 == len(parts)
                    deeper |= {number + 1} - {len(parts)}
            yield own, matches
            if is_folder and deeper:
                todo.append((own, deeper))


def _of_csv(where: str, folder: Path, name: Any) -> Iterable[dict[str, str]]:
    if not isinstance(name, str):
        raise InputError(where, f"{str(name)[:40]}, expected a file like faces.csv")
    path = placed(folder, name)
    if is_url(path):
        address = checked(path, trust().urls)
        data = Store(address).read(address, _MOST_BYTES)
    else:
        check_copied(where, Path(path), folder / "plan")
        data = read_bytes(Path(path), _MOST_BYTES)
    ends = data.count(b"\n")
    if ends > _MOST_ROWS + 1 or data.count(b",") + ends > _MOST_VALUES:
        raise InputError(path, f"expected at most {_MOST_ROWS:,} faces and {_MOST_VALUES:,} values")
    return _cells(path, data)


def _cells(path: str, data: bytes) -> Iterator[dict[str, str]]:
    try:
        lines = io.TextIOWrapper(io.BytesIO(data), "utf-8-sig", newline="\n")  # a StringIO takes four bytes for each
        reader = csv.reader(lines, strict=True)
        header = [one.strip() for one in next(reader, [])]
        if len(header) > _MOST_COLUMNS:
            raise InputError(path, f"{len(header)} columns, expected at most {_MOST_COLUMNS}")
        if not header or len({*header}) != len(header) or "" in header:
            raise InputError(path, "expected a first line with a name for each column, each once")
        for line in reader:
            cells = [one.strip() for one in line]
            if not any(cells):
                continue
            if len(cells) != len(header):
                raise InputError(f"{path} -> line {reader.line_num}", f"{len(cells)} values, expected {len(header)}")
            yield dict(zip(header, cells, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"is no CSV file: {error}") from None
