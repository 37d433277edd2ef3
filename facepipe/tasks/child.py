"""Processes for tasks, here and on a Dask cluster, each task in one of its own: a crash or an overrun ends it alone."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import logging
import queue
import secrets
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any, Protocol

from facepipe.core import __version__
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy import children
from facepipe.core.policy.children import remote_python
from facepipe.core.threads import THREADS
from facepipe.tasks.ledger import FAILED, Record

PROGRAM = "facepipe.tasks.program"  # a module that answers requests, a line of JSON each, from its standard input
LOST = "lost"  # status of a task whose process ended before it answered
Done = Callable[[Record], object]
Told = Callable[[Mapping[str, Any]], object]  # of progress: text, and share from 0 to 1
_PAUSE = 0.2  # seconds between two looks at its memory
ONE_THREAD = dict.fromkeys(
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
_CONNECT = 10.0  # seconds for a scheduler to answer
_PATIENCE = 30.0  # seconds for all workers
_WORKERS = 120.0  # seconds for a first worker
_LOOK, _ABSENT = 10.0, 600.0  # seconds between two looks for workers, and without any, after which it is over
_IDLE = "10 minutes"  # after these a scheduler that was started by ssh ends, and its workers: who started it was killed


class ChildLostError(FacepipeError):
    """The process has ended, or was ended, before it answered."""


class Child:
    """The process, started for the first request and again after it was lost."""

    def __init__(self, setting: Mapping[str, Any]) -> None:
        """:param setting: what the program is given first: folder, roots, models, version; `program`: another one"""
        self._setting = setting
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()

    def ask(
        self,
        request: Mapping[str, Any],
        seconds: float | None,
        memory_mb: float | None,
        told: Told | None = None,
    ) -> dict[str, Any]:
        """The answer to a request.

        :param seconds: it may take
        :param memory_mb: the process may have
        :param told: called with the progress of a request that asks for it
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
                if "progress" in record:
                    if told is not None:
                        told(record["progress"])
                    continue
                if record.pop("grown", False):
                    self.end()
                return record
            if until is not None and time.monotonic() > until:
                self.end()
                raise ChildLostError(request["task"], f"took more than {seconds:g} seconds")
            used = 0.0  # MB
            if memory_mb is not None:
                try:
                    import psutil
                except ImportError:
                    raise InputError("memory", "needs psutil: pip install 'facepipe[farm]'") from None
                with contextlib.suppress(psutil.Error):  # it is gone
                    used = float(psutil.Process(process.pid).memory_info().rss) / 1e6
            if memory_mb is not None and used > memory_mb:
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
        process = children.start(children.python(self._setting.get("program", PROGRAM)), ONE_THREAD, **pipes)
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


class Engine(Protocol):
    """Does tasks, and calls back from any thread when one is done.

    The record of an engine that can go no further has the reason as `gone`; `warnings` are lines for the report.
    """

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done, told: Told | None = None) -> None:
        """Do a task, before those of a higher order."""

    def cancel(self, task: str) -> None:
        """End a task that is being done: it is lost."""

    def close(self) -> None:
        """End; what is being done is lost."""


def answer(child: Child, request: Mapping[str, Any], told: Told | None = None) -> Record:
    """A task done by a child; where that is lost, a record that says so."""
    try:
        return child.ask(request, request.get("seconds"), request.get("memory_mb"), told)
    except ChildLostError as error:
        return {"task": request["task"], "words": request["words"], "status": LOST, "error": str(error)}
    except FacepipeError as error:
        return {"task": request["task"], "words": request["words"], "status": FAILED, "error": str(error)}


class Processes:
    """Processes on this machine, each with one thread."""

    def __init__(self, count: int, setting: Mapping[str, Any]) -> None:
        self._tasks: queue.PriorityQueue[Any] = queue.PriorityQueue()
        self._numbers = itertools.count()
        self._doing: dict[Child, str] = {}
        self._children = [Child(setting) for _ in range(count)]
        for child in self._children:
            threading.Thread(target=self._serve, args=(child,), daemon=True).start()

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done, told: Told | None = None) -> None:
        """Do a task, before those of a higher order."""
        self._tasks.put((order, next(self._numbers), request, done, told))

    def cancel(self, task: str) -> None:
        """End a task that is being done: it is lost."""
        for child, doing in list(self._doing.items()):
            if doing == task:
                child.end()

    def close(self) -> None:
        """End; what is being done is lost."""
        for child in self._children:
            self._tasks.put(((-(1 << 62),), next(self._numbers), None, None, None))
            child.end()

    def _serve(self, child: Child) -> None:
        while True:
            _, _, request, done, told = self._tasks.get()
            if request is None:
                return
            self._doing[child] = request["task"]
            record = answer(child, request, told)
            self._doing.pop(child)
            done(record)


_children: dict[int, tuple[dict[str, Any], Child]] = {}  # thread of a worker -> its process, and its setting
_doing: dict[int, str] = {}  # thread of a worker -> the task that its process does


class Cluster:
    """The workers of a scheduler."""

    def __init__(self, address: str, setting: Mapping[str, Any], processes: int | None = None) -> None:
        """
        :param address: ``tcp://HOST:PORT`` of a scheduler, or ``ssh://HOST,HOST`` to start one on the first host and a
            worker on each
        :param processes: on each host of ssh; None: a core each
        :raises InputError: Dask is not installed, no scheduler answers, none has a worker, or one of another facepipe
        """
        try:
            from distributed import Client, SSHCluster
        except ImportError:
            raise InputError("--cluster", "needs Dask: pip install 'facepipe[farm]'") from None
        for name in list(logging.root.manager.loggerDict):
            if name.startswith(("distributed", "tornado", "asyncssh")):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        self._setting = dict(setting)
        self._refused: dict[str, str] = {}  # worker -> why
        self._last: tuple[str, Done] | None = None  # a task, and whom to call
        self._told: dict[str, Told] = {}  # by task
        self._topic = f"facepipe-{secrets.token_hex(8)}"  # of progress; topics stay on the scheduler
        self._tell = ThreadPoolExecutor(1)  # Dask's own loop must not wait
        self._over = threading.Event()
        with contextlib.ExitStack() as ends:
            try:
                target: Any = address
                if address.startswith("ssh://"):
                    hosts = [one for one in address.removeprefix("ssh://").split(",") if one]
                    if not hosts:
                        raise InputError(f"--cluster {address}", "no host, expected ssh://HOST,HOST")
                    options: Any = {
                        "worker_options": {} if processes is None else {"nthreads": processes},
                        "scheduler_options": {"idle_timeout": _IDLE},
                        "remote_python": remote_python(),
                    }
                    target = ends.enter_context(SSHCluster([hosts[0], *hosts], **options))
                self._client = ends.enter_context(Client(target, timeout=_CONNECT, set_as_default=False))
                self._client.wait_for_workers(1, timeout=_WORKERS)
                self._client.subscribe_topic(self._topic, self._hear)
                versions = self._on_all(_version)
                for worker, version in versions.items():
                    if isinstance(version, ImportError | AttributeError):
                        raise InputError(worker, f"has no facepipe that can work for {__version__} ({_brief(version)})")
                    if isinstance(version, str) and version != __version__:
                        raise InputError(worker, f"has facepipe {version}, expected {__version__}")
            except InputError:
                raise
            except Exception as error:
                raise InputError(f"--cluster {address}", f"can't be used: {_brief(error)}") from None
            self._ends = ends.pop_all()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done, told: Told | None = None) -> None:
        """Do a task, before those of a higher order."""
        self._last = request["task"], done
        if told is not None:
            self._told[request["task"]], request = told, {**request, "topic": self._topic}
        self._client.loop.add_callback(self._follow, request, order, done)

    def cancel(self, task: str) -> None:
        """End a task that is being done: it is lost."""
        threading.Thread(target=self._on_all, args=(_end_task, task), daemon=True).start()

    def close(self) -> None:
        """End; what is being done is lost."""
        gone = self._over.is_set() or self._client.status != "running"
        self._over.set()
        if not gone:
            with contextlib.suppress(Exception):
                self._on_all(_end_children, self._setting)
        with contextlib.suppress(Exception):  # of a scheduler that hangs
            self._ends.close()

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        _, said = event
        if (told := self._told.get(said["task"])) is not None:
            self._tell.submit(told, said["progress"])

    def _watch(self) -> None:
        """A scheduler that hangs, or has no workers and gets none, is gone too: Dask waits for it without an end."""
        seen = time.monotonic()
        while not self._over.wait(_LOOK):
            with contextlib.suppress(Exception):  # tasks hear of a scheduler that was lost themselves
                if self._client.sync(self._client.scheduler.ncores, callback_timeout=_PATIENCE):
                    seen = time.monotonic()
            if self._last is not None and time.monotonic() - seen > _ABSENT:
                self._over.set()
                task, done = self._last
                done({"task": task, "gone": f"no scheduler with workers has answered for {_ABSENT:g} seconds"})

    def _on_all(self, function: Callable[..., object], *arguments: object) -> dict[str, Any]:
        """What a function gives on each worker, or the error that it raises there."""
        run = self._client.run
        answers: dict[str, Any] = self._client.sync(
            run, function, *arguments, on_error="return", callback_timeout=_PATIENCE
        )
        return answers

    async def _follow(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done) -> None:
        record = await self._answer(request, order, await self._others())
        while "refused" in record:
            self._refused[record["worker"]] = record["error"]
            others = await self._others()
            if not others:
                break
            record = await self._answer(request, order, others)
        record.pop("worker", None)
        self._told.pop(request["task"], None)
        warnings = [f"{worker}: {why}; its tasks go to others" for worker, why in self._refused.items()]
        done({**record, "warnings": warnings} if warnings else record)

    async def _others(self) -> list[str]:
        """Where some have refused, the workers that have not; none where the cluster is gone."""
        if not self._refused:
            return []
        try:
            return [one for one in await self._client.nthreads() if one not in self._refused]
        except Exception:  # `_answer` says so
            return []

    async def _answer(self, request: Mapping[str, Any], order: tuple[int, ...], workers: Sequence[str]) -> Record:
        """The record of a task that has ended.

        :param workers: that may do it, as long as there are any; empty: all
        """
        said = json.dumps([request, self._setting, workers], sort_keys=True).encode()
        key = f"facepipe-{request['task']}-{hashlib.sha256(said).hexdigest()[:32]}"
        where: Any = {"workers": list(workers), "allow_other_workers": True} if workers else {}
        record: Record = {"task": request["task"], "words": request["words"], "status": LOST}
        try:
            settings: Any = {"key": key, "pure": False, "priority": -order[0], **where}
            found: Record = await self._client.submit(_do, dict(request), self._setting, **settings)
        except CancelledError:
            return {**record, "gone": "the cluster is gone"}
        except Exception as error:
            if self._client.status in ("closing", "closed"):
                return {**record, "gone": "the cluster is gone"}
            return {**record, "error": f"{request['task']}: its workers were lost ({_brief(error)})"}
        return found


def _do(request: Mapping[str, Any], setting: Mapping[str, Any]) -> Record:
    """Do a task in the process of this thread."""
    from distributed import get_worker

    known = _children.get(threading.get_ident())
    if known is None or known[0] != setting:
        if known is not None:
            known[1].end()
        known = _children[threading.get_ident()] = dict(setting), Child(setting)
    worker = get_worker()

    def told(progress: Mapping[str, Any]) -> None:
        worker.log_event(request["topic"], {"task": request["task"], "progress": dict(progress)})

    _doing[threading.get_ident()] = request["task"]
    try:
        return {**answer(known[1], request, told if "topic" in request else None), "worker": worker.address}
    finally:
        del _doing[threading.get_ident()]


def _end_task(task: str) -> None:
    """End the process of a worker that does a task."""
    for thread, doing in list(_doing.items()):
        if doing == task:
            _children[thread][1].end()


def _end_children(setting: Mapping[str, Any]) -> None:
    """End the processes of a worker that have a setting."""
    for known, child in list(_children.values()):
        if known == setting:
            child.end()


def _version() -> str:
    return __version__


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
