"""Files and folders that appear whole or not at all, alone or several together."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path

from facepipe.core import placing
from facepipe.core.errors import ChangedError, InputError, system_errors
from facepipe.core.placing import (
    HiddenFolder,
    Move,
    Role,
    exchange,
    flush,
    identity,
    patiently,
    place,
    settle,
    sync_file,
    sync_folder,
    undo,
    write_journal,
)
from facepipe.core.policy.paths import PREFIX, check_written

AnyPath = str | os.PathLike[str]
_log = logging.getLogger(__name__)


@contextlib.contextmanager
def replacing(path: AnyPath) -> Iterator[Path]:
    """A temporary path with `path`'s name; it takes its place when the block ends well, and is removed otherwise.

    A file that was there lends its mode; a link to it stays, and the file that it points at is replaced. Within
    `together` the place is taken when that ends.

    :raises InputError: the folder does not exist or can't be written, `path` is no file, or a link to nothing or out
        of the roots
    """
    target = _real(path)
    if not target.parent.is_dir():
        raise InputError(path, "the folder does not exist")
    if os.path.lexists(target) and not target.is_file():
        raise InputError(path, "is a folder, expected a file" if target.is_dir() else "is no regular file")
    with system_errors(path, "can't be written"), _in_group(target) as group:
        temporary = target if group is None else group.home(target.parent) / target.name
        try:
            yield temporary
            if group is not None:
                _finish_file(temporary, target)
                group.add(target)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def replacing_folder(path: AnyPath) -> Iterator[Path]:
    """A new folder; it takes the place of `path` when the block ends well, and is removed with all in it otherwise.

    A folder that was there is lost as a whole. Links and `together` are as for `replacing`.

    :raises InputError: the folder around it does not exist or can't be written, a file is in its place, or another
        process changes it meanwhile
    """
    target = _real(path)
    if not target.parent.is_dir():
        raise InputError(path, "the folder around it does not exist")
    if target.exists() and not target.is_dir():
        raise InputError(path, "is a file, expected a folder")
    former = identity(target)
    with system_errors(path, "can't be written"), _in_group(target) as group:
        temporary = target if group is None else group.home(target.parent) / target.name
        try:
            temporary.mkdir()
            yield temporary
            if group is not None:
                _lend_mode(target, temporary)
                for parent, _, names in os.walk(temporary):
                    for name in names:
                        sync_file(Path(parent, name))
                    sync_folder(Path(parent))
                if identity(target) != former:
                    raise ChangedError(path, "was changed meanwhile, expected no other process to write there")
                group.add(target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise


def write_bytes(path: AnyPath, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def together(path: AnyPath) -> Iterator[None]:
    """All that is written in the block takes its place when it ends, or nothing does, even if the process is killed.

    Files are placed in the order in which they were finished. Old ones are moved away before the first new one comes;
    `path` itself is replaced in one step. So a new file is never seen beside an old one that it doesn't belong to. What
    a killed process left to do is done by the next that writes there, or by `collect`. A block within another is part
    of that one.

    :param path: the file that the others belong to
    :raises InputError: a place can't be taken
    """
    if _group.get() is not None:
        yield
        return
    with _Group(_real(path)) as group:
        token = _group.set(group)
        try:
            yield
        finally:
            _group.reset(token)
        with system_errors(path, "can't be written"):
            group.commit()


@contextlib.contextmanager
def apart() -> Iterator[None]:
    """What is written in the block takes its place at once, within `together` too."""
    token = _group.set(None)
    try:
        yield
    finally:
        _group.reset(token)


def discard_stale(path: Path) -> None:
    """Remove a file, or a link, within `together`: once all that is written is in place."""
    target = path.parent.resolve() / path.name
    with _in_group(target) as group:
        if group is not None:
            group.home(target.parent)
            group.add(target, "stale")


def when_placed(call: Callable[[], object]) -> None:
    """Call now, within `together` once all that is written is in place."""
    group = _group.get()
    if group is None:
        call()
    else:
        group.calls.append(call)


@contextlib.contextmanager
def hidden_folder(parent: Path) -> Iterator[Path]:
    """A temporary folder in `parent` for files that nobody should see; after a kill the next process removes it.

    :raises InputError: `parent` does not exist or can't be written, or a link leads out of the roots
    """
    check_written(parent / "any")
    if not parent.is_dir():
        raise InputError(parent, "the folder does not exist")
    with _Group(parent.resolve() / "any") as group:
        with system_errors(parent, "can't be written"):
            inner = group.home(parent.resolve()) / "files"
            inner.mkdir()
        yield inner


def collect(folder: Path) -> None:
    """Clean up after killed processes in `folder`: hidden files go, and what they had begun to place is placed."""
    for held in placing.left_behind(folder):
        settle(held)


class _Group:
    """What takes its place together."""

    def __init__(self, main: Path) -> None:
        self._main, self._key = main, secrets.token_hex(8)
        self._homes: dict[Path, HiddenFolder] = {}
        self._written: dict[Path, Role] = {}
        self._left = False  # to the next process
        self.calls: list[Callable[[], object]] = []

    def __enter__(self) -> _Group:
        collect(self._main.parent)
        return self

    def __exit__(self, *_: object) -> None:
        for home in self._homes.values():
            (placing.release if self._left else placing.remove)(home)

    def home(self, parent: Path) -> Path:
        """The hidden folder in `parent`, which is without links; macOS may know it in another case too."""
        parent = next((home for home in self._homes if home.samefile(parent)), parent)
        if parent not in self._homes:
            if parent != self._main.parent:
                collect(parent)
            self._homes[parent] = placing.make(parent, self._key)
        return self._homes[parent].path

    def add(self, target: Path, role: Role | None = None) -> None:
        """Take `target`, whose new state is in its hidden folder."""
        self._written.pop(target, None)
        alone = target == self._main and not target.is_dir()
        self._written[target] = role or ("main" if alone else "beside")

    def commit(self) -> None:
        """:raises OSError: a place can't be taken; nothing is changed then"""
        moves = [
            Move(self.home(target.parent), target.name, identity(target), role)
            for target, role in self._written.items()
        ]
        in_one_step = len(moves) == 1 and moves[0].role != "stale"
        if in_one_step and moves[0].former is not None and moves[0].target.is_dir():
            in_one_step = exchange(moves[0].source, moves[0].target)
        elif in_one_step:
            patiently(moves[0].source.replace, moves[0].target)
        if moves and not in_one_step:
            write_journal(moves, [home.path for home in self._homes.values()])
            try:
                place(moves)
            except OSError:
                self._left = True  # unless all is taken back
                self._left = not undo(moves)
                raise
            except BaseException:  # Ctrl-C: a few renames more
                self._left = True
                place(moves)
                self._left = False
                raise
        for parent in self._homes:
            sync_folder(parent)
        for move in moves:
            _log.debug("%s: %s", move.target, "removed" if move.role == "stale" else "written")
        for call in self.calls:
            call()


_group: ContextVar[_Group | None] = ContextVar("facepipe_files_together", default=None)


@contextlib.contextmanager
def _in_group(target: Path) -> Iterator[_Group | None]:
    """The group that `target` goes with: that of `together`, else one of its own; None within a hidden folder."""
    group = _group.get()
    if placing.is_within_live(target):
        yield None
    elif group is not None:
        yield group
    else:
        with _Group(target) as group:
            yield group
            group.commit()


def _real(path: AnyPath) -> Path:
    """`path` in a folder without links; where it is one itself, what it points at.

    :raises InputError: it points at nothing, or a link leads out of the roots
    """
    target = Path(path)
    if target.name.casefold().startswith(PREFIX):  # systems may not distinguish case
        raise InputError(path, f"names of '{PREFIX}...' are for facepipe's temporary files, expected another")
    if target.is_symlink() and not target.exists():
        raise InputError(path, "is a link to nothing, expected a file or a link to one")
    check_written(target)
    return target.resolve() if target.is_symlink() else target.parent.resolve() / target.name


def _finish_file(temporary: Path, target: Path) -> None:
    with temporary.open("rb+") as file:
        _lend_mode(target, temporary)
        flush(file.fileno())


def _lend_mode(old: Path, new: Path) -> None:
    """On Windows a mode says read-only alone: such a file can't be replaced, nor a temporary one removed."""
    if sys.platform != "win32" and old.exists():
        new.chmod(old.stat().st_mode & 0o777)
