"""Hidden folders ``.facepipe-KEY``: files are made in one beside their places. It is locked while its maker lives."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from facepipe.core.locks import try_lock
from facepipe.core.policy.paths import PREFIX

JOURNAL = f"{PREFIX}journal"
_LOCK = f"{PREFIX}lock"
_NAME = re.compile(r"\.facepipe-[0-9a-f]{16}")
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}
_ABANDONED = 86400.0  # seconds until a folder on storage without locks counts as left behind

_live: set[Path] = set()  # of this process


class HiddenFolder(NamedTuple):
    """One that this process holds."""

    path: Path
    lock: int | None  # a descriptor; None on storage without locks


def make(parent: Path, key: str) -> HiddenFolder:
    """A new folder in `parent`, whose path is without links.

    :raises OSError: it can't be made
    """
    path = parent / f"{PREFIX}{key}"
    while True:
        path.mkdir(exist_ok=True)
        with contextlib.suppress(BlockingIOError, FileNotFoundError):  # another took it for one that is left behind
            lock = _locked(path, create=True)
            _live.add(path)
            return HiddenFolder(path, lock)
        time.sleep(0.001)


def remove(folder: HiddenFolder) -> None:
    """Remove it with all in it."""
    path = folder.path
    with contextlib.suppress(OSError):
        (path / JOURNAL).unlink(missing_ok=True)  # first: half of what it names must not be placed
    if folder.lock is not None:
        os.close(folder.lock)
    _live.discard(path)
    with contextlib.suppress(OSError):
        # the lock goes last: without it nobody finishes this
        for entry in sorted(path.iterdir(), key=lambda entry: entry.name == _LOCK):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()
        path.rmdir()


def release(folder: HiddenFolder) -> None:
    """Leave it with all in it to the next who looks for `left_behind`."""
    if folder.lock is not None:
        os.close(folder.lock)
    _live.discard(folder.path)


def is_within_live(path: Path) -> bool:
    """Whether `path`, without links, is in such a folder of this process: nobody sees it yet."""
    return any(parent in _live for parent in path.parents)


def left_behind(parent: Path) -> Iterator[HiddenFolder]:
    """Folders in `parent` whose makers are dead, each held by this process."""
    try:
        with os.scandir(parent) as entries:
            names = sorted(entry.name for entry in entries if _NAME.fullmatch(entry.name))
    except OSError:  # nothing that we could clean up
        return
    for name in names:
        held = claim(parent / name)
        if held is not None:
            yield held


def claim(path: Path) -> HiddenFolder | None:
    """The folder, held, where its maker is dead; None where it lives, or this is no such folder."""
    if path.is_symlink():
        return None
    try:
        return HiddenFolder(path, _locked(path, create=False))
    except FileNotFoundError:  # killed as soon as it was made, or being made: then it is made again
        with contextlib.suppress(OSError):
            path.rmdir()
    except OSError:
        pass
    return None


def _locked(path: Path, *, create: bool) -> int | None:
    """The lock's descriptor; None on storage without locks.

    :raises OSError: it is another's
    """
    file = path / _LOCK
    try:
        return try_lock(file, create=create)
    except OSError as error:
        if error.errno not in _NO_LOCKS or (not create and time.time() - file.stat().st_mtime < _ABANDONED):
            raise
        return None
