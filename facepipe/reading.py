"""Bytes of files, up to a size that a reader can want."""

from __future__ import annotations

from pathlib import Path

from facepipe.errors import InputError


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
