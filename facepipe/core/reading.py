"""Bytes, JSON, TOML, CSV and digests of files, up to a limit on their size."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import stat
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError, system_errors
from facepipe.core.policy.paths import check_found, check_readable

_MOST_VALUES = 3_000_000  # of a JSON or TOML file
_MOST_COLUMNS, _MOST_ROWS = 4096, 1 << 20  # of a table: each cell becomes an object
_MOST_DOTS = 100  # of a line: tomllib takes the square of a key's length
_URL = re.compile(r"[A-Za-z][\w+.-]+:/")  # as paths have one: with one slash; Windows' drives have a letter
_KEY_DOT = re.compile(rb"[^\d\s]\s*\.|\.\s*[^\d\s]|\.\s*\d+\s*\.")  # no decimal point


def check_input(path: Path) -> None:
    """Check what the caller names, before anything else.

    :raises InputError: a URL; a pipe or device, which a reader could wait on without end; or it may not be read
    """
    if _URL.match(path.as_posix()):
        raise InputError(path.as_posix().replace(":/", "://", 1), "is a URL, expected a file or folder")
    check_readable(path)
    try:
        fine = not path.exists() or path.is_file() or path.is_dir()
    except ValueError:  # a name with a NUL
        fine = True
    if not fine:
        raise InputError(path, "is not a regular file")


def check_regular(path: Path, most: int | None = None) -> int:
    """The size of a regular file, of at most `most` bytes.

    :raises InputError: not there, a folder, pipe or device, larger, or may not be read
    """
    check_readable(path)
    try:
        state = path.stat()
    except (OSError, ValueError) as error:  # a name with a NUL
        raise InputError(path, f"can't be read: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(state.st_mode):
        raise InputError(path, "is not a regular file")
    if most is not None and state.st_size > most:
        raise InputError(path, f"larger than {most} bytes")
    return state.st_size


def is_file(path: Path) -> bool:
    """Whether `path` is a file; False for a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def files_in(folder: Path, suffixes: Collection[str] = ()) -> list[Path]:
    """The files of a folder by name, but for hidden ones.

    :param suffixes: in lower case, of those that are wanted; none: all
    :raises InputError: it can't be read, or a link in it leads outside the roots
    """
    check_readable(folder)
    with system_errors(folder, "can't be read"):
        found = sorted(one for one in folder.iterdir() if not one.name.startswith("."))
        wanted = [one for one in found if not suffixes or one.suffix.lower() in suffixes]
        for one in wanted:
            check_found(one, folder)
        return [one for one in wanted if one.is_file()]


def file_beside(path: Path, *names: str) -> Path | None:
    """The first file of these names that is there, in the folder `path` or beside the file `path`.

    :raises InputError: a link there leads outside the roots
    """
    folder = path if path.is_dir() else path.parent
    for one in (folder / name for name in names):
        check_found(one, path)
        if is_file(one):
            return one
    return None


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file of at most `most` bytes.

    :raises InputError: not readable, no regular file, or larger
    """
    size = check_regular(path, most)
    with system_errors(path, "can't be read"), path.open("rb") as file:
        return file.read(size)  # no more: files in /proc report 0 bytes, and some never end


def read_json(path: Path, most: int) -> object:
    """The JSON in a file of at most `most` bytes, as people write it: a key twice is a mistake.

    :raises InputError: not readable, not JSON, a key twice, or text that is no Unicode
    """
    try:
        data = read_bytes(path, most)
        check_values(path, data)
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=_object)
        if b"\\u" in data:  # an escape can be half a surrogate pair
            json.dumps(content, ensure_ascii=False).encode()
        return content
    except UnicodeEncodeError:
        raise InputError(path, "text with half a surrogate pair, expected Unicode") from None
    except (ValueError, RecursionError) as error:  # bad UTF-8 too
        raise InputError(path, f"is not JSON ({error})") from None
    except _TwiceError as error:
        raise InputError(path, f"'{error}' twice, expected each key once") from None


def read_json_object(path: Path, most: int) -> dict[str, object]:
    """The JSON object in a file, as `read_json`.

    :raises InputError: as `read_json`, or another value than an object
    """
    content = read_json(path, most)
    if not isinstance(content, dict):
        raise InputError(path, f"{str(content)[:40]}, expected a JSON object")
    return content


def check_values(where: object, data: bytes) -> None:
    """Check a text of JSON before it is parsed: two bytes of it can become an object of a hundred.

    :raises InputError: too many values
    """
    if sum(map(data.count, (b",", b":", b"[", b"{"))) > _MOST_VALUES:
        raise InputError(where, f"more than {_MOST_VALUES} values")


def check_json(where: object, value: object, levels: int) -> None:
    """Check JSON of others before it is kept as text.

    :raises InputError: deeper than `levels`, or text that UTF-8 can't hold
    """
    level: list[object] = [value]
    for _ in range(levels):
        try:
            for text in level:
                if isinstance(text, str):
                    text.encode()
        except UnicodeEncodeError:
            raise InputError(where, "text with half a surrogate pair, expected Unicode") from None
        inner = [one for one in level if isinstance(one, dict | list)]
        level = [deeper for one in inner for deeper in ([*one, *one.values()] if isinstance(one, dict) else one)]
    if level:
        raise InputError(where, f"more than {levels} levels of JSON")


def read_toml(path: Path, most: int) -> dict[str, Any]:
    """The TOML in a file of at most `most` bytes.

    :raises InputError: not readable, or not TOML
    """
    data = read_bytes(path, most)
    for number, line in enumerate(data.split(b"\n"), 1):
        if line.count(b".") > _MOST_DOTS < len(_KEY_DOT.findall(line)):
            raise InputError(f"{path}:{number}", f"more than {_MOST_DOTS} dotted keys")
    check_values(path, data)
    try:
        import tomllib

        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # bad UTF-8 too
        raise InputError(path, f"is not TOML ({str(error)[:120]})") from None


def read_csv(path: Path, most: int) -> tuple[str, list[tuple[int, list[str]]]]:
    """The delimiter of a file of at most `most` bytes; line and stripped cells of each row.

    It is a comma, semicolon, tab or bar, or spaces where the header has none of these. Excel's line ``sep=;`` may stand
    before.

    :raises InputError: not readable, no UTF-8 or UTF-16, not CSV, or too many columns or rows
    """
    data = read_bytes(path, most)
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")  # what spreadsheets call Unicode text
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 (byte {error.start}), expected CSV saved as UTF-8") from None
    first = text.lstrip().partition("\n")[0]
    delimiter = max(",;\t|", key=first.count)
    if first.startswith("sep=") and len(first.rstrip("\r ")) == len("sep=;"):
        delimiter = first[4]
    elif delimiter not in first and " " in first.strip():
        delimiter = " "
    try:
        reader = csv.reader(
            io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=delimiter == " ", strict=True
        )
        rows: list[tuple[int, list[str]]] = []
        for cells in reader:
            if len(cells) > _MOST_COLUMNS or len(rows) == _MOST_ROWS:
                what = f"more than {_MOST_COLUMNS} columns" if len(cells) > _MOST_COLUMNS else f"over {_MOST_ROWS} rows"
                raise InputError(f"{path} -> line {reader.line_num}", what)
            row = [cell.strip() for cell in cells]
            if any(row) and (rows or row != ["sep=", ""]):
                rows.append((reader.line_num, row))
    except csv.Error as error:
        raise InputError(path, f"is not CSV ({str(error)[:120]})") from None
    return delimiter, rows


class _TwiceError(Exception):
    """A key that an object has twice."""


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content: dict[str, object] = {}
    for key, value in pairs:
        if key in content:
            raise _TwiceError(key[:60])
        content[key] = value
    return content


def digest(files: Iterable[Path]) -> str:
    """``sha256:...`` of one file's bytes, or, for several, of their sorted lines ``<sha256>  <file name>``.

    :raises InputError: a file can't be read
    """
    sums = []
    for path in files:
        check_regular(path)
        with system_errors(path, "can't be read"), path.open("rb") as file:
            sums.append((path.name, hashlib.file_digest(file, "sha256").hexdigest()))
    sums.sort()
    if len(sums) == 1:
        return f"sha256:{sums[0][1]}"
    listing = "".join(f"{value}  {name}\n" for name, value in sums)
    return f"sha256:{hashlib.sha256(listing.encode()).hexdigest()}"
