"""Hidden folders, and how what is made in them is put in place together, even if processes are killed meanwhile.

A journal in the first hidden folder is the step that decides: before it all is old, after it all is new, or will be
when the next process writes there. It may come from anywhere, so a move only goes from a hidden folder to a plain name
in the folder around, and only over what its writer saw there.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from facepipe.core.locks import try_lock
from facepipe.core.policy.paths import PREFIX

JOURNAL = f"{PREFIX}journal"
_LOCK = f"{PREFIX}lock"
_NAME = re.compile(r"\.facepipe-[0-9a-f]{16}")
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}
_ABANDONED = 86400.0  # seconds until a folder on storage without locks counts as left behind

_live: set[Path] = set()  # of this process
Identity = tuple[int, int, int]  # inode, size, time of change
Role = Literal["main", "beside", "stale"]

_JOINED = f"{PREFIX}joined"
_MAX_TEXT = 1 << 22  # bytes
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD; RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS
_PATIENCE, _PAUSE = 1.0, 0.02  # seconds that a step is tried for on Windows, and between two tries
_NOT_FOR_FOLDERS = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EBADF, errno.EACCES, errno.EPERM}


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


@dataclass(frozen=True)
class Move:
    """One name: its new file or folder, and what was there."""

    hidden: Path  # folder that has the new one
    name: str
    former: Identity | None
    role: Role  # main: replaced in one step; beside: the old one goes before anything new comes; stale: goes at last

    @property
    def source(self) -> Path:
        """The new one, until it is placed."""
        return self.hidden / self.name

    @property
    def target(self) -> Path:
        """Its place."""
        return self.hidden.parent / self.name

    @property
    def aside(self) -> Path:
        """Where the old one is kept meanwhile."""
        return self.hidden / f"{PREFIX}former" / self.name

    @property
    def waits(self) -> bool:
        """Whether it is still to be placed."""
        return self.role != "stale" and os.path.lexists(self.source)

    @property
    def disturbed(self) -> bool:
        """Whether it waits, and another has written to its place since."""
        return self.waits and identity(self.target) not in (None, self.former)


def identity(path: Path) -> Identity | None:
    """A mark that differs between files, and before and after a change of one; None where there is none."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def place(moves: Sequence[Move]) -> None:
    """Take every step that is not taken yet.

    :raises OSError: one is not possible
    """
    for move in moves:
        if move.role == "beside" and move.former is not None and identity(move.target) == move.former:
            move.aside.parent.mkdir(exist_ok=True)
            patiently(move.target.rename, move.aside)
    for move in moves:
        if move.waits:
            patiently(move.source.replace, move.target)
    for move in moves:
        if move.role == "stale" and identity(move.target) == move.former:
            move.target.unlink(missing_ok=True)


def patiently(step: Callable[[Path], object], target: Path) -> None:
    """Rename to `target`; on Windows again for a while, where scanners and indexers hold files for a moment.

    :raises OSError: it is not possible
    """
    until = time.monotonic() + _PATIENCE
    while True:
        try:
            step(target)
        except PermissionError:
            if sys.platform != "win32" or time.monotonic() > until:
                raise
            time.sleep(_PAUSE)
        else:
            return


def undo(moves: Sequence[Move]) -> bool:
    """Take the steps back; False where the main file is new already, and all has to go on."""
    if _decided(moves):
        return False
    for move in reversed(moves):
        if move.role != "stale" and not move.waits:
            patiently(move.target.rename, move.source)
    _restore(moves)
    return True


def _decided(moves: Sequence[Move]) -> bool:
    """Whether a main file was replaced: the old one is lost."""
    return any(move.role == "main" and move.former is not None and not move.waits for move in moves)


def _restore(moves: Sequence[Move]) -> None:
    """Put back what is aside where its place is free."""
    for move in moves:
        if os.path.lexists(move.aside) and not os.path.lexists(move.target):
            patiently(move.aside.rename, move.target)


def write_journal(moves: Sequence[Move], folders: Sequence[Path]) -> None:
    """From here on all of `moves` are made, by this process or another.

    :param folders: hidden folders that have what is moved; the journal goes to the first
    """
    first = folders[0]
    for other in folders[1:]:
        _write(other / _JOINED, relative(first.parent, other.parent))
    steps = [(folders.index(move.hidden), move.name, move.former, move.role) for move in moves]
    parents = [relative(folder.parent, first.parent) for folder in folders]
    _write(first / JOURNAL, json.dumps({"folders": parents, "moves": steps}))


def settle(folder: HiddenFolder) -> None:
    """End what a killed process began, all new where it had got that far, else all old; remove its hidden folder."""
    joined = _text(folder.path / _JOINED)
    if joined is None:
        _finish(folder)
        return
    try:
        first = _beside(folder.path, joined)
    except ValueError:
        first = folder.path  # which has no journal
    if _text(first / JOURNAL) is None:
        remove(folder)
        return
    release(folder)
    held = claim(first)
    if held is not None:  # else another settles it now
        _finish(held)


def _finish(folder: HiddenFolder) -> None:
    # the moves that a journal names; none where there is no journal, or none that `write_journal` wrote
    try:
        content = json.loads(_text(folder.path / JOURNAL) or "")
        folders = [_beside(folder.path, one) for one in content["folders"]]
        moves = [_move(folders, *one) for one in content["moves"]]
    except (ValueError, TypeError, LookupError, RecursionError):
        moves = []
    moves = [
        move
        for move in moves
        if stat.S_ISDIR(_mode(move.hidden))
        and not any(stat.S_ISLNK(_mode(one)) for one in (move.source, move.aside.parent))
    ]
    others = {move.hidden for move in moves} - {folder.path}
    try:
        if any(move.disturbed for move in moves) and not _decided(moves):
            _restore(moves)
        else:
            place([move for move in moves if not move.disturbed])
        for parent in {move.hidden.parent for move in moves}:
            sync_folder(parent)
    except OSError:  # for one who may
        release(folder)
        return
    for held in filter(None, map(claim, others)):
        remove(held)
    remove(folder)


def _move(folders: Sequence[Path], number: Any, name: Any, former: Any, role: Any) -> Move:
    """:raises ValueError: what `write_journal` doesn't write"""
    plain = isinstance(name, str) and name and not re.search(r"[/\\:\0]", name) and name not in (".", "..")
    known = former is None or (len(former) == 3 and all(type(one) is int for one in former))
    if not plain or name.casefold().startswith(PREFIX) or not known or role not in get_args(Role):
        raise ValueError(name)
    os.fsencode(name)  # a name that no file can have
    return Move(folders[number], name, None if former is None else tuple(former), role)


def _beside(hidden: Path, folder: Any) -> Path:
    """The hidden folder in `folder`, as seen from around `hidden`, of the same key.

    :raises ValueError: `folder` is on another machine, or no path
    """
    if not isinstance(folder, str) or folder.startswith(("//", "\\\\")) or "\0" in folder:
        raise ValueError(folder)
    os.fsencode(folder)  # a name that no file can have
    return hidden.parent / folder / hidden.name


def _mode(path: Path) -> int:
    try:
        return path.lstat().st_mode
    except OSError:
        return 0


def _text(path: Path) -> str | None:
    """A small file's text; None where there is none."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode) or path.stat().st_size > _MAX_TEXT:
            return None
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None


def relative(path: str | Path, start: Path) -> str:
    """A path as seen from a folder, with slashes; as it is where it is on another drive of Windows."""
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:
        return Path(path).as_posix()


def _write(path: Path, text: str) -> None:
    """Text that a loss of power leaves whole, and the folder around its folder with it."""
    path.write_text(text, encoding="utf-8")
    sync_file(path)
    sync_folder(path.parent)
    sync_folder(path.parent.parent)


def sync_file(path: Path) -> None:
    """Have the system write a file's bytes to the disk."""
    with path.open("rb+") as file:
        flush(file.fileno())


def flush(descriptor: int) -> None:
    """Have the system write what is open to the disk; macOS else leaves it in the disk's own memory."""
    if sys.platform == "darwin":
        import fcntl

        with contextlib.suppress(OSError):  # on storage that has no such call
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
    os.fsync(descriptor)


def sync_folder(path: Path) -> None:
    """Have the system write a folder's names to the disk, where it can."""
    if sys.platform == "win32":
        return
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            flush(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _NOT_FOR_FOLDERS:
            raise


def exchange(first: Path, second: Path) -> bool:
    """Two folders in each other's places, in one step; False where the system has no such step."""
    import ctypes

    libc: Any = ctypes.CDLL(None) if sys.platform in ("linux", "darwin") else None
    names = os.fsencode(first), os.fsencode(second)
    if sys.platform == "linux" and hasattr(libc, "renameat2"):
        return bool(libc.renameat2(_HERE, names[0], _HERE, names[1], _EXCHANGE) == 0)
    if sys.platform == "darwin" and hasattr(libc, "renamex_np"):
        return bool(libc.renamex_np(*names, _EXCHANGE) == 0)
    return False
