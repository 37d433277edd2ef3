"""A Dask scheduler and workers, processes of their own over TCP, which are ended by their ids."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import psutil

PATIENCE = 300.0  # seconds, of machines that are busy with others too
T = TypeVar("T")


class Farm:
    """A scheduler, and the workers that were started."""

    def __init__(self, folder: Path, made_up: bool) -> None:
        """:param made_up: workers do the lines of `farm_child`"""
        self._made_up = made_up
        self._folder = folder
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler, self.address = self._scheduler("0")

    def worker(self, *, nanny: bool = False, **environment: str) -> subprocess.Popen[bytes]:
        """One more, of one thread."""
        words = [self.address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "10"]
        words += [] if nanny else ["--no-nanny"]
        words += ["--local-directory", str(self._folder), *(["--preload", "farm_worker"] if self._made_up else [])]
        worker = self._start("worker", *words, **environment)
        self.workers.append(worker)
        return worker

    def restart(self) -> None:
        """Kill the scheduler, and start another at its address."""
        self.scheduler.kill()
        self.scheduler.wait()
        self.scheduler, _ = self._scheduler(self.address.rpartition(":")[2])

    def _scheduler(self, port: str) -> tuple[subprocess.Popen[bytes], str]:
        said = self._folder / "scheduler.json"
        said.unlink(missing_ok=True)
        words = ["--host", "127.0.0.1", "--port", port, "--no-dashboard", "--scheduler-file", str(said)]
        return self._start("scheduler", *words), until(lambda: _address(said))

    def _start(self, what: str, *words: str, **environment: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{what}.log").open("ab") as log:
            line = [sys.executable, "-m", f"distributed.cli.dask_{what}", *words]
            return subprocess.Popen(line, stdout=log, stderr=log, env={**os.environ, **environment})

    def end(self) -> None:
        """End all that is still there."""
        for one in (*self.workers, self.scheduler):
            one.kill()
            one.wait()


def _address(said: Path) -> str:
    """What a scheduler's file says; nothing before it is written whole."""
    try:
        return str(json.loads(said.read_text())["address"])
    except (OSError, ValueError):
        return ""


@contextmanager
def farm_in(folder: Path, workers: int = 0, made_up: bool = True) -> Iterator[Farm]:
    """A cluster while the block runs; its logs are in the folder."""
    folder.mkdir()
    farm = Farm(folder, made_up)
    try:
        for _ in range(workers):
            farm.worker()
        yield farm
    finally:
        farm.end()


def until(asked: Callable[[], T], seconds: float = PATIENCE) -> T:
    """What `asked` gives as soon as it is true.

    :raises AssertionError: it never was
    """
    start = time.monotonic()
    while not (found := asked()):
        assert time.monotonic() - start < seconds, "it never came"
        time.sleep(0.05)
    return found


def children(process: subprocess.Popen[bytes]) -> set[int]:
    """The ids of all processes below one."""
    return {child.pid for child in psutil.Process(process.pid).children(recursive=True)}
