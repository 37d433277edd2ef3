"""Files that one process changes at a time, so that none overwrites what another has written meanwhile."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from facepipe.core.errors import InputError, system_errors
from facepipe.core.policy.paths import check_written

_PAUSE = 0.05  # seconds between two tries
_FLAGS = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # a link or pipe is no lock


@contextlib.contextmanager
def locked(
    path: str | os.PathLike[str], patience: float = 600.0, waiting: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Hold the lock of `path` while the block runs; it need not exist.

    The operating system's lock on a file ``.NAME.lock`` beside it. It ends with the process that holds it; the file may
    stay after a kill, and always does on Windows, but locks nothing.

    :param patience: seconds to wait for another holder
    :param waiting: called once if there is one
    :raises InputError: it is held for longer, it has no name (``.``), the folder does not exist or can't be written, or
        a link leads out of the roots
    """
    target = Path(path)
    check_written(target)
    if not target.name:
        raise InputError(target, "is a folder, expected a file")
    if not target.parent.is_dir():
        raise InputError(target, "the folder does not exist")
    file = _file(target)
    until, descriptor, announced = time.monotonic() + patience, None, False
    while descriptor is None:
        with system_errors(target, "can't be locked"), contextlib.suppress(BlockingIOError):
            descriptor = try_lock(file)
            break
        if time.monotonic() > until:
            raise InputError(target, "is being changed by another process, expected one at a time")
        if not announced:
            waiting()
            announced = True
        time.sleep(_PAUSE)
    try:
        yield
    finally:
        _release(file, descriptor)


def discard_lock(path: Path) -> None:
    """Remove the lock file of `path` that a killed holder left, where there is one."""
    file = _file(path)
    with contextlib.suppress(OSError):
        _release(file, try_lock(file, create=False))


def try_lock(file: Path, *, create: bool = True) -> int:
    """A descriptor of `file`, locked until it is closed or its process ends.

    :raises BlockingIOError: another holds it, or has removed it since it was opened
    :raises OSError: it can't be opened, or its storage has no locks
    """
    descriptor = os.open(file, _FLAGS | os.O_CREAT if create else _FLAGS, 0o666)
    try:
        if _lock(descriptor) and _is(file, descriptor):
            return descriptor
        raise BlockingIOError
    except BaseException:
        os.close(descriptor)
        raise


def _file(target: Path) -> Path:
    return target.with_name(f".{target.name}.lock")


def _release(file: Path, descriptor: int) -> None:
    if sys.platform != "win32":  # there, who waits has it open, and it can't be removed
        with contextlib.suppress(OSError):
            file.unlink()
    os.close(descriptor)


def _is(file: Path, descriptor: int) -> bool:
    """Whether the file is still there: who held it before may have removed it between opening and locking."""
    try:
        return os.path.samestat(file.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> bool:
        """Whether it was free."""
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True

else:
    import fcntl

    def _lock(descriptor: int) -> bool:
        """Whether it was free."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
