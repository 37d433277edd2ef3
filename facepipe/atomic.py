"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from facepipe.errors import InputError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix; renamed over it when the block ends well, removed when not.

    :raises InputError: the folder does not exist or can't be written
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise InputError(target, "the folder does not exist")
    if target.is_dir():
        raise InputError(target, "is a folder, expected a file")
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(target)
    except OSError as error:
        raise InputError(target, f"can't be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # a folder that can't be written has nothing to remove
            temporary.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
