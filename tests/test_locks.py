"""Locks: one holder at a time, and nobody after its holder is gone."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from facepipe.errors import InputError
from facepipe.locks import locked

_HOLDER = """
import sys, time
from facepipe.locks import locked
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
    path, told = tmp_path / "faces.fpdb", []
    holder = _holder(path)
    try:
        with (
            pytest.raises(InputError, match=r"faces\.fpdb: is being changed by another process"),
            locked(path, patience=0.0, waiting=lambda: told.append(1)),
        ):
            pass
    finally:
        holder.kill()
        holder.wait()
    with locked(path, patience=30.0):  # the lock of a process that was killed is gone
        assert len(told) <= 1


def test_an_error_within_gives_the_lock_back(tmp_path: Path) -> None:
    path = tmp_path / "faces.fpdb"
    with pytest.raises(ValueError, match="within"), locked(path):
        raise ValueError("within")
    with locked(path, patience=0.0):
        pass


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder does not exist"), locked(tmp_path / "none" / "faces.fpdb"):
        pass
