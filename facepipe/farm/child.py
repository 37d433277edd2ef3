"""Processes for tasks, each task in one of its own: a crash or an overrun ends that process alone."""

from __future__ import annotations

import contextlib
import itertools
import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy import children
from facepipe.core.threads import THREADS
from facepipe.farm.ledger import FAILED, Record

PROGRAM = "facepipe.cli.batch_child"  # a module that answers requests, a line of JSON each, from its standard input
_PAUSE = 0.2  # seconds between two looks at its memory
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "PXR_WORK_THREAD_LIMIT",
        THREADS,
    ),
    "1",
)


class ChildLostError(FacepipeError):
    """The process has ended, or was ended, before it answered."""


class Child:
    """The process, started for the first request and again after it was lost."""

    def __init__(self, setting: Mapping[str, Any]) -> None:
        """:param setting: what the program is given first: folder, roots, models, version"""
        self._setting = setting
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()

    def ask(self, request: Mapping[str, Any], seconds: float | None, memory_mb: float | None) -> dict[str, Any]:
        """The answer to a request.

        :param seconds: it may take
        :param memory_mb: the process may have
        :raises ChildLostError: it has ended, could not be started, or took more than that
        """
        try:
            process = self._process or self._start()
        except OSError as error:  # no memory, say: another may be had later
            raise ChildLostError(request["task"], f"its process can't be started: {error.strerror or error}") from None
        self._send(process, request)
        until = None if seconds is None else time.monotonic() + seconds
        while True:
            with contextlib.suppress(queue.Empty):
                answer = self._answers.get(timeout=_PAUSE)
                if answer is None:
                    code = self.end()
                    why = f"signal {-code}" if code < 0 else f"exit code {code}"
                    raise ChildLostError(request["task"], f"its process ended ({why})")
                record: dict[str, Any] = json.loads(answer)
                if record.pop("grown", False):
                    self.end()
                return record
            if until is not None and time.monotonic() > until:
                self.end()
                raise ChildLostError(request["task"], f"took more than {seconds:g} seconds")
            used = None if memory_mb is None else _memory_of(process.pid)
            if used is not None and memory_mb is not None and used > memory_mb:
                self.end()
                raise ChildLostError(request["task"], f"took {used:.0f} MB, expected at most {memory_mb:g}")

    def end(self) -> int:
        """End the process; its exit code."""
        process, self._process = self._process, None
        if process is None:
            return 0
        with contextlib.suppress(OSError):
            process.kill()
        code = process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        return code

    def _start(self) -> subprocess.Popen[bytes]:
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        process = children.start(children.python(PROGRAM), _ONE_THREAD, **pipes)
        self._process, self._answers = process, queue.SimpleQueue()
        threading.Thread(target=_pump, args=(process.stdout, self._answers), daemon=True).start()
        self._send(process, self._setting)
        return process

    def _send(self, process: subprocess.Popen[bytes], content: Mapping[str, Any]) -> None:
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended: `ask` sees that
            process.stdin.write(json.dumps(content).encode() + b"\n")
            process.stdin.flush()


def _pump(pipe: Any, answers: queue.SimpleQueue[bytes | None]) -> None:
    with contextlib.suppress(OSError, ValueError):
        for line in pipe:
            answers.put(line)
    answers.put(None)


def _memory_of(pid: int) -> float | None:
    """The memory that a process has [MB]; None where it is gone.

    :raises InputError: psutil is not installed
    """
    try:
        import psutil
    except ImportError:
        raise InputError("memory", "needs psutil: pip install 'facepipe[farm]'") from None
    try:
        return float(psutil.Process(pid).memory_info().rss) / 1e6
    except psutil.Error:
        return None


Done = Callable[[Record], object]
LOST = "lost"  # status of a task whose process ended before it answered


class Engine(Protocol):
    """Does tasks, and calls back from any thread when one is done.

    The record of an engine that can go no further has the reason as `gone`; `warnings` are lines for the report.
    """

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done) -> None:
        """Do a task, before those of a higher order."""

    def close(self) -> None:
        """End; what is being done is lost."""


def answer(child: Child, request: Mapping[str, Any]) -> Record:
    """A task done by a child; where that is lost, a record that says so."""
    try:
        return child.ask(request, request.get("seconds"), request.get("memory_mb"))
    except ChildLostError as error:
        return {"task": request["task"], "words": request["words"], "status": LOST, "error": str(error)}
    except FacepipeError as error:
        return {"task": request["task"], "words": request["words"], "status": FAILED, "error": str(error)}


class Processes:
    """Processes on this machine, each with one thread."""

    def __init__(self, count: int, setting: Mapping[str, Any]) -> None:
        self._tasks: queue.PriorityQueue[Any] = queue.PriorityQueue()
        self._numbers = itertools.count()
        self._children = [Child(setting) for _ in range(count)]
        for child in self._children:
            threading.Thread(target=self._serve, args=(child,), daemon=True).start()

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done) -> None:
        """Do a task, before those of a higher order."""
        self._tasks.put((order, next(self._numbers), request, done))

    def close(self) -> None:
        """End; what is being done is lost."""
        for child in self._children:
            self._tasks.put(((-(1 << 62),), next(self._numbers), None, None))
            child.end()

    def _serve(self, child: Child) -> None:
        while True:
            _, _, request, done = self._tasks.get()
            if request is None:
                return
            done(answer(child, request))
