"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
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


@contextlib.contextmanager
def replacing_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A new folder beside `path`; takes its place when the block ends well, with all in it is removed when not.

    A folder that was there is lost as a whole.

    :raises InputError: the folder around it does not exist or can't be written, or a file is in its place
    """
    target = Path(path).resolve()
    if not target.parent.is_dir():
        raise InputError(path, "the folder around it does not exist")
    if target.exists() and not target.is_dir():
        raise InputError(path, "is a file, expected a folder")
    key = secrets.token_hex(4)
    temporary, former = (target.with_name(f".{target.name}.{key}{end}") for end in ("", ".former"))
    try:
        temporary.mkdir()
        yield temporary
        _swap(temporary, target, former)
    except OSError as error:
        raise InputError(path, f"can't be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _swap(folder: Path, target: Path, former: Path) -> None:
    """`folder` in the place of `target`, which is `former` meanwhile: a rename can't replace a folder with files."""
    if target.exists():
        target.rename(former)
    try:
        folder.rename(target)
    except OSError:
        if former.exists():
            former.rename(target)
        raise
    shutil.rmtree(former, ignore_errors=True)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
