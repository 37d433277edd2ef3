"""Who does tasks: processes on this machine. `facepipe.farm.cluster` has those of a Dask cluster."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from facepipe.core.errors import FacepipeError
from facepipe.farm.child import Child, ChildLostError
from facepipe.farm.ledger import Record
from facepipe.farm.work import FAILED

Done = Callable[[Record], object]
LOST = "lost"  # status of a task whose process ended before it answered


class Engine(Protocol):
    """Does tasks, and says when one is done from any thread.

    A record of an engine that can do no more has the reason as `gone`; `warnings` are lines for the report.
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
