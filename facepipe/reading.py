"""Bytes and JSON of files, up to a size that a reader can want."""

from __future__ import annotations

import json
from pathlib import Path

from facepipe.errors import InputError


def check_input(path: Path) -> None:
    """:raises InputError: `path` is a pipe or a device, which a reader could wait on without end"""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(path, "is not a regular file")


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file of at most `most` bytes.

    :raises InputError: not readable, no regular file, or larger
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(path, "is not a regular file")
        if path.stat().st_size > most:
            raise InputError(path, f"larger than {most} bytes")
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error


def read_json(path: Path, most: int) -> object:
    """The JSON in a file of at most `most` bytes, as people write it: a key twice is a mistake.

    :raises InputError: not readable, not JSON, or a key twice
    """
    try:
        return json.loads(read_bytes(path, most).decode("utf-8-sig"), object_pairs_hook=_object)
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


class _TwiceError(Exception):
    """A key that an object has twice."""


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found: dict[str, object] = {}
    for key, value in pairs:
        if key in found:
            raise _TwiceError(key[:60])
        found[key] = value
    return found
