"""Warm sessions, each in a process of its own: few, bounded in memory, and opened again when they are asked for."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from facepipe.core import __version__
from facepipe.core.errors import FacepipeError
from facepipe.core.policy import children
from facepipe.server.library import Version, new_id
from facepipe.server.session_program import LENGTHS
from facepipe.tasks.child import ONE_THREAD

PROGRAM = "facepipe.server.session_program"
_OPENING = 300.0  # seconds: sources of other topologies take half a minute each
_PATIENCE = 120.0  # seconds for an answer: payloads of a busy machine take so long
_MOST_WAITING = 16  # for one session: who asks beyond that has gone before the answer would come


class SessionError(FacepipeError):
    """The session says no, or is lost."""


class LostError(SessionError):
    """Its process has ended."""

    status = 503


class BusyError(SessionError):
    """All sessions are being opened or asked, or too many wait for one."""

    status = 503


@dataclass(frozen=True)
class Opening:
    """What a session is of: the sources of a blend, or the one face whose sliders move."""

    kind: Literal["blend", "sliders"]
    faces: tuple[Version, ...]
    tenant: str = ""


Lay = Callable[[str, Version, Path], Path]  # lays a tenant's version out below a folder, and gives its stage


@dataclass(frozen=True)
class Answer:
    """Float16 offsets or a payload; `settled`: no other follows by itself."""

    body: bytes
    settled: bool


Later = Callable[[Answer], object]


class _Session:
    """One process, and the folder that its faces are laid out in. All but `_read` runs on the loop."""

    def __init__(self, opening: Opening, folder: Path, lay: Lay) -> None:
        self.loop, self.lock = asyncio.get_running_loop(), asyncio.Lock()
        self.opening, self.mb, self.used, self.lost = opening, 0.0, time.monotonic(), False
        self.opened: asyncio.Future[dict[str, Any]] = self.loop.create_future()
        self.opened.add_done_callback(lambda one: one.cancelled() or one.exception())  # nobody may wait for it any more
        self._folder, self._lay, self._number, self._waiting = folder, lay, 0, 0
        self._asked: asyncio.Future[Answer] | None = None
        self._later: Later | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._starting = self.loop.create_task(self._start())

    async def _start(self) -> None:
        def started() -> subprocess.Popen[bytes]:
            self._folder.mkdir(parents=True, mode=0o700)
            stages = [str(self._lay(self.opening.tenant, one, self._folder)) for one in self.opening.faces]
            pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            process = children.start(children.python(PROGRAM), ONE_THREAD, **pipes)
            setting = {"version": __version__, "roots": [str(self._folder)], self.opening.kind: stages}
            _send(process, setting)
            return process

        try:
            self._process = await asyncio.to_thread(started)
        except OSError as error:
            self._gone(SessionError("session", f"can't be started ({error.strerror or error})"))
            return
        except FacepipeError as error:
            self._gone(error)
            return
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()
        if self.lost:  # ended meanwhile
            self._process.kill()

    @property
    def busy(self) -> bool:
        """Whether somebody waits for it."""
        return not self.opened.done() or self.lock.locked()

    async def ask(self, request: Mapping[str, Any], later: Later | None) -> Answer:
        """:raises SessionError: it says no, or ends, or takes too long, or too many ask"""
        if self._waiting >= _MOST_WAITING:
            raise BusyError("session", f"{_MOST_WAITING} wait for it, expected another try later")
        self._waiting += 1
        try:
            await asyncio.wait_for(asyncio.shield(self.opened), _OPENING)
            async with self.lock:
                return await self._answer(request, later)
        finally:
            self._waiting -= 1

    async def _answer(self, request: Mapping[str, Any], later: Later | None) -> Answer:
        self.used = time.monotonic()
        self._number += 1
        self._asked, self._later = self.loop.create_future(), later
        if self._process is None or self.lost:
            raise LostError("session", "has ended, expected it to answer")
        _send(self._process, {**request, "id": self._number})
        return await asyncio.wait_for(self._asked, _PATIENCE)

    def end(self) -> None:
        """End the process; who waits is told."""
        self.lost = True
        if self._process is not None:
            with contextlib.suppress(OSError):
                self._process.kill()

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        pipe: Any = process.stdout
        with contextlib.suppress(OSError, ValueError):
            while len(lengths := pipe.read(LENGTHS.size)) == LENGTHS.size:
                head, body = (pipe.read(length) for length in LENGTHS.unpack(lengths))
                self._tell(self._take, json.loads(head), body)
        process.wait()
        for one in (process.stdin, pipe):
            with contextlib.suppress(OSError):
                if one is not None:
                    one.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._tell(self._gone)

    def _tell(self, function: Callable[..., object], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self.loop.call_soon_threadsafe(function, *arguments)

    def _take(self, head: Mapping[str, Any], body: bytes) -> None:
        self.mb = head["mb"]
        waiting: asyncio.Future[Any] | None = self._asked if "id" in head else self.opened
        if head.get("id", self._number) != self._number:
            return
        if waiting is None or waiting.done():
            if self._later is not None and head.get("settled"):
                self._later(Answer(body, settled=True))
        elif "error" in head:
            where, _, what = head["error"].replace(f"{self._folder}/", "").partition(": ")
            waiting.set_exception(SessionError(where, what))
        else:
            waiting.set_result(head["opened"] if "opened" in head else Answer(body, settled=head["settled"]))

    def _gone(self, why: FacepipeError | None = None) -> None:
        self.lost = True
        shutil.rmtree(self._folder, ignore_errors=True)
        for one in (self.opened, self._asked):
            if one is not None and not one.done():
                one.set_exception(why or LostError("session", "has ended, expected it to answer"))


def _send(process: subprocess.Popen[bytes], content: Mapping[str, Any]) -> None:
    """A line, shorter than what its pipe holds: each waits for the answer to the one before."""
    assert process.stdin is not None
    with contextlib.suppress(OSError, ValueError):  # it has ended, and its pipe is closed: who waits is told
        process.stdin.write(json.dumps(content).encode() + b"\n")
        process.stdin.flush()


class Sessions:
    """The warm sessions of a server.

    :param folder: in which faces are laid out, each session's apart, as long as it is there
    :param lay: brings a version's files into such a folder
    :param most: of them at once
    :param most_mb: memory of all of them
    """

    def __init__(self, folder: Path, lay: Lay, most: int = 16, most_mb: float = 8192.0) -> None:
        self._folder, self._lay, self._most, self._most_mb = folder, lay, most, most_mb
        self._open: dict[Opening, _Session] = {}
        self.sockets = 0  # over which they are asked

    async def opened(self, opening: Opening) -> dict[str, Any]:
        """What a session is of: regions or sliders, and meshes with their points.

        :raises SessionError: files that can't be used, or no room
        """
        session = self._session(opening)
        with _ending(session, "is not open", _OPENING):
            return await asyncio.wait_for(asyncio.shield(session.opened), _OPENING)

    async def ask(self, opening: Opening, request: Mapping[str, Any], later: Later | None = None) -> Answer:
        """The answer of a session, which is opened where it isn't, or has been ended meanwhile.

        :param request: ``{"weights": ...}``, or ``{"values": ..., "wanted": "offsets" or "payload"}``
        :param later: called with a settled answer, unless another request comes before that is there
        :raises SessionError: weights or values that don't fit, files that can't be used, or no room
        """
        for last in (False, True):  # one that has crashed since is opened again; a request that ends it twice is told
            session = self._session(opening)
            try:
                with _ending(session, "has not answered", _PATIENCE):
                    answer = await session.ask(request, later)
            except LostError:
                if last:
                    raise
                continue
            self._shrink(session)
            return answer
        raise AssertionError

    def forget(self, tenant: str, face: str | None = None) -> None:
        """End the sessions of a face that was deleted, or of a tenant, from any thread; their copies go with them."""
        for opening, session in list(self._open.items()):
            named = face is None or any(version.face == face for version in opening.faces)
            if opening.tenant == tenant and named and self._open.pop(opening, None) is not None:
                session.end()

    def close(self) -> None:
        """End them all."""
        for session in self._open.values():
            session.end()
        self._open.clear()

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._open)

    def _session(self, opening: Opening) -> _Session:
        session = self._open.get(opening)
        if session is not None and not session.lost:
            session.used = time.monotonic()
            return session
        self._open.pop(opening, None)
        for gone in [one for one, other in self._open.items() if other.lost]:
            del self._open[gone]
        while len(self._open) >= self._most:
            if not self._end_one():
                raise BusyError("session", f"all {self._most} are being used, expected a free one: try again")
        session = self._open[opening] = _Session(opening, self._folder / new_id(), self._lay)
        return session

    def _shrink(self, used: _Session) -> None:
        """End sessions until the others have no more memory than they may."""
        while sum(one.mb for one in self._open.values()) > self._most_mb:
            if not self._end_one(used):
                break
        if used.mb > self._most_mb:
            used.end()

    def _end_one(self, kept: _Session | None = None) -> bool:
        """End the one that was used least lately, of those that nobody waits for; whether there was one."""
        idle = [opening for opening, one in self._open.items() if not one.busy and one is not kept]
        if idle:
            self._open.pop(min(idle, key=lambda opening: self._open[opening].used)).end()
        return bool(idle)


@contextlib.contextmanager
def _ending(session: _Session, what: str, seconds: float) -> Iterator[None]:
    """End a session that takes too long."""
    try:
        yield
    except TimeoutError:
        session.end()
        raise SessionError("session", f"{what} after {seconds:g} seconds, and was ended") from None
