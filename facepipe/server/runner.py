"""The work of a server: jobs that are claimed and done, and what is made of versions for those who wait for it.

Each has a folder of its own below ``work/``, which confines what its process reads and writes, and is removed with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import logging
import os
import queue
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from facepipe.core import __version__
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.reading import read_json
from facepipe.server import remote
from facepipe.server.jobs import LOST, STOPPED, Jobs
from facepipe.server.library import STAGE, Library, Version, new_id
from facepipe.server.program import MADE
from facepipe.server.refusals import AwayError, RefusedError
from facepipe.server.tables import DatabaseError
from facepipe.server.uploads import Uploads
from facepipe.tasks.child import Cluster, Engine, Processes, Told
from facepipe.tasks.ledger import FAILED, Record
from facepipe.tasks.remote import StoreError

T = TypeVar("T")
UPLOAD = "upload"  # the action of a job that takes a face in
_FILES = "files"  # folder of uploads in that of a job
_NEW = "new"  # folder of the version that is made; its number is known when it is there
_IDLE, _BEAT, _PAUSE, _AWAY = 1.0, 10.0, 1.0, 5.0  # seconds
_ON_CLUSTER = 16  # jobs at once
_MAKING = 2  # processes for what is made of versions
_MOST_WAITING = 200  # for these
_MOST_LANDMARKS = 1 << 16  # bytes of a file of them
_log = logging.getLogger("facepipe.server")


class Bus:
    """Tells those who wait for news of a job on the server's loop."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: defaultdict[str, set[asyncio.Event]] = defaultdict(set)

    def begin(self) -> None:
        """Of the running loop."""
        self._loop = asyncio.get_running_loop()

    def tell(self, job: str) -> None:
        """There is news, from any thread."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # closed
                self._loop.call_soon_threadsafe(self._set, job)

    async def wait(self, job: str, seconds: float) -> None:
        """Wait for news, not longer than that: those of other servers are seen in the rows alone."""
        event = asyncio.Event()
        self._waiting[job].add(event)
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(event.wait(), seconds)
        finally:
            self._waiting[job].discard(event)
            if not self._waiting[job]:
                del self._waiting[job]

    def _set(self, job: str) -> None:
        for event in self._waiting.get(job, ()):
            event.set()


class Runner:
    """Threads that claim jobs, and processes that do them."""

    def __init__(
        self,
        library: Library,
        jobs: Jobs,
        uploads: Uploads,
        folder: Path,
        *,
        processes: int | None = None,
        cluster: str | None = None,
        seconds: float = 1800.0,
        memory_mb: float | None = None,
    ) -> None:
        """:raises InputError: a cluster that can't be used"""
        self.bus = Bus()
        self._library, self._jobs, self._uploads, self._folder = library, jobs, uploads, folder
        self._limits = {"seconds": seconds, "memory_mb": memory_mb}
        shutil.rmtree(folder, ignore_errors=True)  # what a killed server has left
        folder.mkdir(parents=True, mode=0o700)
        (folder / "idle").mkdir()
        self._setting = {
            "folder": str(folder / "idle"),
            "roots": [str(folder / "idle")],
            "urls": [],
            "models": False,
            "local": None,
            "local_bytes": 0,
            "version": __version__,
            "program": "facepipe.server.program",
        }
        count = processes or (_ON_CLUSTER if cluster else os.cpu_count() or 1)
        self._processes, self._cluster = count, cluster
        self._engine: Engine | None = None
        self._engines = threading.Lock()
        self._stopping, self._wake = threading.Event(), threading.Semaphore(0)
        self._making: defaultdict[tuple[Version, str], threading.Lock] = defaultdict(threading.Lock)
        self._makers = Processes(_MAKING, self._setting)
        self._pool = ThreadPoolExecutor(_MAKING, "making")
        self._waiting = 0
        self._doing: dict[str, str | None] = {}  # job -> its latest picture, which no row ever has
        self._engine_of()  # a cluster that can't be used is told before anything is accepted
        jobs.take_back()
        jobs.beat()
        names = [self._work] * count + [self._keep_house]
        self._threads = [threading.Thread(target=one, daemon=True) for one in names]
        for thread in self._threads:
            thread.start()

    @property
    def stopping(self) -> bool:
        """Whether it is being ended."""
        return self._stopping.is_set()

    def pictured(self, job: dict[str, Any]) -> dict[str, Any]:
        """A job with the picture of how it stands, where it is being done here and has one."""
        picture = job["progress"] and self._doing.get(job["id"])
        return job if picture is None else {**job, "progress": {**job["progress"], "picture": picture}}

    def wake(self) -> None:
        """There is a new job."""
        self._wake.release()

    def cancel(self, job: str) -> None:
        """End the process that does a job, where that is here."""
        if job in self._doing and self._engine is not None:
            self._engine.cancel(job)
        self._uploads.end(job)
        self.bus.tell(job)

    def close(self) -> None:
        """End; what is being done is queued again."""
        self._stopping.set()
        for _ in self._threads:
            self._wake.release()
        self._makers.close()
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._engine is not None:
            self._engine.close()
        for thread in self._threads:
            thread.join(20.0)
        shutil.rmtree(self._folder, ignore_errors=True)

    async def made(self, tenant: str, version: Version, name: str) -> str | None:
        """The digest of a file of a version, which is made where it isn't there; None where the face has no such.

        :raises RefusedError: no such version, or too many wait
        :raises FacepipeError: a face that a format can't hold
        """
        there = await asyncio.to_thread(self._library.artefact, tenant, version, name)
        if there is not None or name not in MADE:
            return there
        return await self._in_turn(self._make, tenant, version, name)

    async def landmarks(self, tenant: str, photo: str) -> Any:
        """Where the landmarks of the face in a photo are; they are kept nowhere.

        :raises RefusedError: no such photo, or too many wait
        :raises FacepipeError: no face in it, or several
        """
        return await self._in_turn(self._find, tenant, photo)

    async def _in_turn(self, do: Callable[..., T], *given: Any) -> T:
        if self._waiting >= _MOST_WAITING:
            raise AwayError("server", "is busy, expected another try later")
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._pool, do, *given)
        finally:
            self._waiting -= 1

    def _make(self, tenant: str, version: Version, name: str) -> str | None:
        what = MADE[name]
        with self._making[version, what]:
            there = self._library.artefact(tenant, version, name)
            # the first of a page's files is always made with the others: a face without sliders has no more
            first = next(one for one, of in MADE.items() if of == what)
            if there is None and self._library.artefact(tenant, version, first) is None:
                with self._place(new_id()) as folder:
                    stage = self._library.lay(tenant, version, folder)
                    words = ["derive", str(stage.relative_to(folder)), what, "made"]
                    record = self._asked(self._makers, folder.name, folder, words, None)
                    if record["status"] in (LOST, FAILED):
                        raise FacepipeError(name, _said(record, folder))
                    self._library.keep(tenant, version, folder / "made")
                there = self._library.artefact(tenant, version, name)
        self._making.pop((version, what), None)
        return there

    def _find(self, tenant: str, photo: str) -> Any:
        with self._place(new_id()) as folder:
            path = self._uploads.lay(tenant, photo, folder)
            words = ["find", str(path.relative_to(folder)), "landmarks.json"]
            record = self._asked(self._makers, folder.name, folder, words, None)
            if record["status"] in (LOST, FAILED):
                raise InputError("photo", _said(record, folder))
            return read_json(folder / words[-1], _MOST_LANDMARKS)

    def _work(self) -> None:
        while not self._stopping.is_set():
            job = None
            with contextlib.suppress(DatabaseError):
                job = self._jobs.claim()
            if job is None:
                self._wake.acquire(timeout=_IDLE)
                continue
            self._doing[job.id] = None
            self.bus.tell(job.id)
            try:
                self._do(job)
            except Exception as error:  # a fault of ours: the others go on
                _log.error("job failed: %s", type(error).__name__)
                self._patiently(functools.partial(self._jobs.failed, job, "a fault of the server"))
            finally:
                self._doing.pop(job.id, None)
                with contextlib.suppress(DatabaseError):
                    if not self._stopping.is_set():
                        self._uploads.end(job.id)
                self.bus.tell(job.id)

    def _do(self, job: Any) -> None:
        with self._place(f"{job.id}-{job.attempt}") as folder:
            try:
                words, sources = self._laid(job, folder)
                record = self._asked(self._engine_of(), job.id, folder, words, self._told(job))
                if record["status"] in (LOST, FAILED):
                    self._not_done(job, record, folder)
                    return
                files = self._library.stored(job.tenant, job.face, folder / job.face / _NEW)
            except (DatabaseError, StoreError, AwayError):
                self._patiently(lambda: self._jobs.again(job, STOPPED))
                self._stopping.wait(_AWAY)
                return
            except FacepipeError as error:
                said = str(error)
                self._patiently(lambda: self._jobs.failed(job, said))
                return
        names = ("report", "missed", "attribution", "seconds", "peak_mb")
        report = {name: record[name] for name in names if name in record}
        try:
            kept = self._patiently(lambda: self._jobs.done(job, files, sources, report))
        except RefusedError as error:
            kept, said = False, str(error)
            self._patiently(lambda: self._jobs.failed(job, said))
        if not kept:  # cancelled, or done by another
            self._patiently(lambda: self._library.clear(job.tenant, job.face))

    def _laid(self, job: Any, folder: Path) -> tuple[list[str], list[Version]]:
        """Lay out what a job stands on; its line, and the versions among that."""
        out = f"{job.face}/{_NEW}/{STAGE}"
        fields = json.loads(job.fields)
        if job.action == UPLOAD:
            path = self._uploads.lay(job.tenant, fields["upload"], folder / _FILES)
            return ["take", str(path.relative_to(folder)), out], []
        versions, uploads = remote.standing_on(job.action, fields)
        for version in versions:
            self._library.lay(job.tenant, version, folder)
        paths = {one: self._uploads.lay(job.tenant, one, folder / _FILES) for one in uploads}
        placed = remote.placed(job.action, fields, lambda one: str(paths[one].relative_to(folder)))
        return ["act", job.action, json.dumps(placed), out], versions

    def _not_done(self, job: Any, record: Record, folder: Path) -> None:
        error = _said(record, folder)
        if self._stopping.is_set() or record.get("gone"):
            self._patiently(lambda: self._jobs.again(job, STOPPED))
        elif record["status"] == LOST or record.get("passing"):
            self._patiently(lambda: self._jobs.again(job, LOST, error))
        else:
            self._patiently(lambda: self._jobs.failed(job, error))

    def _asked(self, engine: Engine, task: str, folder: Path, words: Sequence[str], told: Told | None) -> Record:
        """The record of a task that has ended."""
        answers: queue.SimpleQueue[Record] = queue.SimpleQueue()
        request = {"task": task, "words": list(words), "folder": str(folder), "progress": told is not None}
        engine.submit({**request, **self._limits}, (0,), answers.put, told)
        while True:
            with contextlib.suppress(queue.Empty):
                record = answers.get(timeout=_IDLE)
                if record.get("gone"):  # a cluster: the next job looks for it again
                    with self._engines:
                        engine.close()
                        self._engine = None
                return {"status": LOST, **record}
            if self._stopping.is_set():
                return {"task": task, "status": LOST, "error": "the server ends"}

    def _engine_of(self) -> Engine:
        with self._engines:
            if self._engine is None:
                try:
                    cluster = None if self._cluster is None else Cluster(self._cluster, self._setting)
                except InputError as error:
                    raise AwayError(error.where, error.what) from None
                self._engine = cluster or Processes(self._processes, self._setting)
            return self._engine

    def _told(self, job: Any) -> Told:
        def told(said: Mapping[str, Any]) -> None:
            if "picture" in said and job.id in self._doing:
                self._doing[job.id] = said["picture"]
            with contextlib.suppress(DatabaseError):
                self._jobs.progress(job, {name: said[name] for name in ("text", "share")})
            self.bus.tell(job.id)

        return told

    def _patiently(self, do: Callable[[], T]) -> T:
        """Do what the rows have to know, as soon as the database answers."""
        while True:
            try:
                return do()
            except DatabaseError:
                if self._stopping.is_set():  # the next start takes the job back
                    raise
                time.sleep(_PAUSE)

    @contextlib.contextmanager
    def _place(self, name: str) -> Any:
        folder = self._folder / name
        folder.mkdir(mode=0o700)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _keep_house(self) -> None:
        while not self._stopping.wait(_BEAT):
            with contextlib.suppress(DatabaseError, OSError):
                self._jobs.beat()
                self._uploads.sweep()


def _said(record: Mapping[str, Any], folder: Path) -> str:
    """Why a task was not done, without the places where it was tried."""
    return str(record.get("error", "was lost")).replace(f"{folder}/", "").replace(str(folder), "its folder")[:500]
