"""Locks: one holder at a time, and nobody after its holder is gone."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from facepipe.core import locks
from facepipe.core.errors import InputError
from facepipe.core.locks import discard_lock, locked

_HOLDER = """
import sys, time
from facepipe.core.locks import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


def _holder(path: Path) -> subprocess.Popen[str]:
    held = subprocess.Popen([sys.executable, "-c", _HOLDER, str(path)], stdout=subprocess.PIPE, text=True)
    assert held.stdout is not None
    assert held.stdout.readline() == "held\n"
    return held


def test_counts_of_many_threads_add_up(tmp_path: Path) -> None:
    counter = tmp_path / "counter"
    counter.write_text("0")

    def count() -> None:
        for _ in range(5):
            with locked(counter):
                before = int(counter.read_text())
                time.sleep(0.002)
                counter.write_text(str(before + 1))

    threads = [threading.Thread(target=count) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter.read_text() == "30"
    if sys.platform != "win32":
        assert [path.name for path in tmp_path.iterdir()] == ["counter"]


def test_another_process_is_waited_for_and_told_of(tmp_path: Path) -> None:
    path, waits = tmp_path / "faces.fpdb", []
    holder = _holder(path)
    try:
        with (
            pytest.raises(InputError, match=r"faces\.fpdb: is being changed by another process"),
            locked(path, patience=0.0, waiting=lambda: waits.append(1)),
        ):
            pass
    finally:
        holder.kill()
        holder.wait()
    with locked(path, patience=30.0):  # the lock of a process that was killed is gone
        assert len(waits) <= 1


def test_an_error_within_gives_the_lock_back(tmp_path: Path) -> None:
    path = tmp_path / "faces.fpdb"
    with pytest.raises(ValueError, match="within"), locked(path):
        raise ValueError("within")
    with locked(path, patience=0.0):
        pass


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder does not exist"), locked(tmp_path / "none" / "faces.fpdb"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="lock files are never removed there")
@pytest.mark.parametrize("path", [".", "./", "/", ""])
def test_a_path_without_a_name_is_told(path: str) -> None:
    with pytest.raises(InputError, match="is a folder, expected a file"), locked(path):
        pass


def test_a_lock_file_that_is_removed_between_opening_and_locking_holds_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who waits opens the file; its holder ends and removes it; a third makes it anew: only the third is in."""
    path, real, third = tmp_path / "faces.fpdb", locks._lock, contextlib.ExitStack()

    def slow(descriptor: int) -> bool:
        monkeypatch.setattr(locks, "_lock", real)
        (tmp_path / ".faces.fpdb.lock").unlink()
        third.enter_context(locked(path, patience=0.0))
        return real(descriptor)

    monkeypatch.setattr(locks, "_lock", slow)
    with third, pytest.raises(InputError, match="another process"), locked(path, patience=0.0):
        pass
    with locked(path, patience=0.0):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="lock files are never removed there")
def test_a_dead_holders_lock_file_is_removed_and_a_living_ones_stays(tmp_path: Path) -> None:
    path, file = tmp_path / "faces.fpdb", tmp_path / ".faces.fpdb.lock"
    holder = _holder(path)
    try:
        discard_lock(path)
        assert file.exists()
    finally:
        holder.kill()
        holder.wait()
    assert file.exists()
    discard_lock(path)
    assert not file.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_is_no_lock(tmp_path: Path) -> None:
    (tmp_path / ".faces.fpdb.lock").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="can't be locked"), locked(tmp_path / "faces.fpdb", patience=0.0):
        pass
    assert not (tmp_path / "elsewhere").exists()
