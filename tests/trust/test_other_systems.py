"""What Windows and macOS do otherwise, simulated: locks, renames over open files, flushes, drives, case of names."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import importlib.util
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from places import names

from facepipe.core import atomic, locks, placing
from facepipe.core.atomic import collect, replacing, replacing_folder, together, write_bytes
from facepipe.core.errors import InputError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="simulates that system on others")


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows by its name, without a step that exchanges folders, and without folders that can be opened."""
    opened = os.open

    def open_file(path: Any, flags: int, *more: Any, **named: Any) -> int:
        if Path(path).is_dir() and "dir_fd" not in named:  # that is how others remove folders, on this system
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, flags, *more, **named)

    monkeypatch.setattr(os, "open", open_file)
    monkeypatch.setattr(sys, "platform", "win32")


@pytest.fixture
def windows_locks(monkeypatch: pytest.MonkeyPatch, windows: None) -> ModuleType:
    """The module of locks as Windows loads it; bytes are locked as msvcrt does, by handles, until these are closed."""

    def locking(descriptor: int, mode: int, size: int) -> None:
        assert (mode, size) == (2, 1)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(LK_NBLCK=2, locking=locking))
    spec = importlib.util.spec_from_file_location("locks_of_windows", locks.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert not hasattr(module, "fcntl")
    return module


def test_windows_locks_exclude_and_their_file_stays(tmp_path: Path, windows_locks: ModuleType) -> None:
    target, order = tmp_path / "faces.fpdb", []

    def other() -> None:
        with windows_locks.locked(target, waiting=lambda: order.append("waits")):
            order.append("second")

    with windows_locks.locked(target):
        with pytest.raises(BlockingIOError):
            windows_locks.try_lock(tmp_path / ".faces.fpdb.lock")
        thread = threading.Thread(target=other)
        thread.start()
        while not order:
            time.sleep(0.001)
        order.append("first")
    thread.join()
    assert order == ["waits", "first", "second"]
    assert names(tmp_path) == [".faces.fpdb.lock"]
    windows_locks.discard_lock(target)  # nobody holds it: who waits may have it open, so it stays there
    with (
        windows_locks.locked(target, patience=0.0),
        pytest.raises(InputError, match="another process"),
        windows_locks.locked(target, patience=0.0),
    ):
        pass


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder with files and a report of before."""
    (tmp_path / "report").mkdir()
    for name in ("main", "beside", "report/one"):
        (tmp_path / name).write_text("old")
    return tmp_path


def write_all(folder: Path) -> None:
    with together(folder / "main"):
        for name in ("main", "beside"):
            write_bytes(folder / name, b"new")
        with replacing_folder(folder / "report") as report:
            (report / "two").write_text("new")


def content(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in names(folder) if (folder / name).is_file()}


NEW = {"main": "new", "beside": "new", "report/two": "new"}
OLD = {"main": "old", "beside": "old", "report/one": "old"}


def held(monkeypatch: pytest.MonkeyPatch, name: str, times: int) -> list[str]:
    """Renames over a file `name` fail so many times, as where another program has it open; the tries."""
    tries: list[str] = []

    def refusing(step: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
        def rename(self: Path, target: Path) -> Path:
            if target.name == name and target.parent.name != ".facepipe-former":
                tries.append(name)
                if len(tries) <= times:
                    raise PermissionError(errno.EACCES, "Access is denied")
            return step(self, target)

        return rename

    monkeypatch.setattr(Path, "replace", refusing(Path.replace))
    monkeypatch.setattr(Path, "rename", refusing(Path.rename))
    return tries


def test_windows_replaces_files_and_folders_together(old: Path, windows: None) -> None:
    write_all(old)
    assert content(old) == NEW


def test_windows_waits_for_a_file_that_is_open_for_a_moment(
    old: Path, windows: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = held(monkeypatch, "main", times=3)
    write_bytes(old / "main", b"new")
    assert (len(tries), content(old)) == (4, {**OLD, "main": "new"})


def test_windows_leaves_all_as_it_was_where_a_file_stays_open(
    old: Path, windows: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placing, "_PATIENCE", 0.1)
    tries = held(monkeypatch, "main", times=1000)
    with pytest.raises(InputError, match="can't be written: Access is denied"):
        write_all(old)
    assert len(tries) > 1
    assert content(old) == OLD
    assert not [*old.glob(".facepipe-*")]


def test_elsewhere_a_refused_rename_is_not_tried_again(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = held(monkeypatch, "main", times=1000)
    with pytest.raises(InputError, match="can't be written"):
        write_bytes(old / "main", b"new")
    assert (len(tries), content(old)) == (1, OLD)


def test_windows_leaves_no_passing_file_behind_a_read_only_one(
    old: Path, windows: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There neither can a read-only file be replaced, nor one be removed."""
    monkeypatch.setattr(placing, "_PATIENCE", 0.0)
    (old / "main").chmod(0o444)
    unlink = Path.unlink

    def remove(self: Path, missing_ok: bool = False) -> None:
        if self.exists() and not self.stat().st_mode & 0o200:
            raise PermissionError(errno.EACCES, "Access is denied")
        unlink(self, missing_ok=missing_ok)

    held(monkeypatch, "main", times=1000)
    monkeypatch.setattr(Path, "unlink", remove)
    with pytest.raises(InputError, match="can't be written"):
        write_bytes(old / "main", b"new")
    assert content(old) == OLD


def write_both(folder: Path) -> None:
    with together(folder / "c/file"):
        write_bytes(folder / "c/file", b"new")
        write_bytes(folder / "d/file", b"new")


def test_files_on_two_drives_are_settled_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No relative path leads from one to the other."""

    def no_way(path: object, start: object = None) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    def killed(moves: object) -> None:
        raise OSError(errno.EIO, "as where the process ends here")

    for drive in ("c", "d"):
        (tmp_path / drive).mkdir()
        (tmp_path / drive / "file").write_text("old")
    with monkeypatch.context() as patch:
        patch.setattr(os.path, "relpath", no_way)
        patch.setattr(atomic, "place", killed)
        patch.setattr(atomic, "undo", lambda moves: False)
        with pytest.raises(InputError):
            write_both(tmp_path)
    assert content(tmp_path / "d")["file"] == "old"
    collect(tmp_path / "d")
    assert content(tmp_path) == {"c/file": "new", "d/file": "new"}


def test_macos_flushes_to_the_disk_itself(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the call that it has for that; with the usual one on storage that lacks it."""
    calls: list[str] = []

    def control(descriptor: int, command: int) -> int:
        calls.append("full")
        if "unable" in calls:
            raise OSError(errno.ENOTSUP, "Operation not supported")
        return 0

    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(fcntl, "F_FULLFSYNC", 51, raising=False)
    monkeypatch.setattr(fcntl, "fcntl", control)
    monkeypatch.setattr(os, "fsync", lambda descriptor: calls.append("usual"))
    write_bytes(old / "main", b"new")
    assert calls == ["full", "full"]  # the file, then its folder
    calls[:] = ["unable"]
    write_bytes(old / "main", b"newer")
    assert calls == ["unable", "full", "usual", "full", "usual"]
    assert content(old)["main"] == "newer"


def test_a_folder_in_another_case_is_the_same_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On macOS, where a path keeps the case in which it was given."""
    shots, shouted = tmp_path / "shots", tmp_path / "SHOTS"
    shots.mkdir()
    monkeypatch.setattr(Path, "samefile", lambda self, other: str(self).casefold() == str(other).casefold())
    with atomic._Group(shots / "main") as group:
        assert group.home(shots) == group.home(shouted)


def test_names_of_passing_files_are_ours_in_any_case(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="for facepipe's temporary files"), replacing(tmp_path / ".Facepipe-lock"):
        pass
    with pytest.raises(ValueError, match="FACEPIPE"):
        placing._move([tmp_path], 0, ".FACEPIPE-lock", None, "main")


def test_no_lock_is_left_where_the_system_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A share of another system may refuse locks: that is an error in one line, not a traceback."""

    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOTSUP, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(InputError, match="can't be locked: Operation not supported"), locks.locked(tmp_path / "x"):
        pass
    with contextlib.suppress(InputError):
        write_bytes(tmp_path / "y", b"new")  # hidden folders do without
    assert (tmp_path / "y").read_bytes() == b"new"
