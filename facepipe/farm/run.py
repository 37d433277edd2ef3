"""A run of a plan: tasks are given out as soon as what they need is there, and their records are kept."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import queue
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.atomic import collect
from facepipe.core.errors import FacepipeError, printable
from facepipe.core.locks import discard_lock
from facepipe.core.policy.paths import Reach, is_url, trust
from facepipe.farm.child import LOST, Engine
from facepipe.farm.contents import state_of, unchanged
from facepipe.farm.ledger import CACHED, FAILED, KEPT, MADE, Ledger, Record
from facepipe.farm.plan import Plan, RunOptions, Task, line_of, needed, result_of, tasks_named, tasks_of
from facepipe.farm.remote import States

DONE = (MADE, KEPT, CACHED)
SKIPPED = "skipped"  # what it needs failed
_IN_FLIGHT = 10_000  # tasks that are given out at once

OnTask = Callable[[Task, Record], object]


@dataclass
class Run:
    """The state of a plan that is run."""

    plan: Plan
    ledger: Ledger
    options: RunOptions
    on_task: OnTask
    roots: tuple[Path, ...]  # which all that its tasks read and write lies below
    records: dict[str, Record] = field(default_factory=dict)  # of this run, by task
    scheduling: float = 0.0  # seconds in this class
    gone: str = ""  # why the engine can go no further
    warnings: dict[str, None] = field(default_factory=dict)  # of the engine

    def __post_init__(self) -> None:
        self._answers: queue.SimpleQueue[Record] = queue.SimpleQueue()
        self._tasks = {task.name: task for task in tasks_of(self.plan)}
        self._waits: dict[str, int] = {}  # task -> how many that it needs are left
        self._for: dict[str, list[str]] = {}  # task -> those that need it
        self._lost: Counter[str] = Counter()
        self._reach = Reach(self.plan.folder, self.roots, trust().urls)
        self._states = States(self.plan.out if is_url(self.plan.out) else "")
        self._ready: list[tuple[tuple[int, int], int, Task]] = []  # a heap
        self._numbers = itertools.count()
        self._out = 0  # tasks given out

    @property
    def counts(self) -> Counter[str]:
        """Tasks by status."""
        return Counter(record["status"] for record in self.records.values())

    @property
    def left(self) -> int:
        """How many tasks have not ended."""
        return len(self._tasks) - len(self.records)

    def __call__(self, engine: Engine) -> None:
        """Do all tasks.

        :raises FacepipeError: the ledger can't be written
        """
        start, waited = time.perf_counter(), 0.0
        taken: dict[str, str] = {}  # result -> the task that makes it
        for name, task in self._tasks.items():
            fault = self.plan.faults.get(task.step.name)
            error = f"steps.{task.step.name}: {fault}" if fault else ""
            try:
                path = "" if error else result_of(self.plan, task)
                if path and taken.setdefault(path, name) != name:
                    error = f"{name}: out is {path}, that of {taken[path]} too, expected another"
            except FacepipeError as wrong:
                error = str(wrong)
            if error:
                self._end(task, {"task": name, "status": FAILED, "error": printable(error)}, keep=False)
        for name, task in self._tasks.items():
            if name in self.records:
                continue
            needs = needed(self.plan, task)
            self._waits[name] = sum(need not in self.records for need in needs)
            for one in needs:
                self._for.setdefault(one, []).append(name)
            if self._waits[name] == 0:
                self._make_ready(task)
        while not self.gone and self._hand_out(engine):
            before = time.perf_counter()
            record = self._answers.get()
            waited += time.perf_counter() - before
            self._out -= 1
            self._answered(record)
        made = (name for record in self.records.values() if record["status"] == MADE for name in record["writes"])
        for folder in {(self.plan.folder / name).parent for name in made if not is_url(name)}:
            with contextlib.suppress(FacepipeError, OSError):
                collect(folder)
        self.scheduling = time.perf_counter() - start - waited

    def _make_ready(self, task: Task) -> None:
        heapq.heappush(self._ready, (task.order, next(self._numbers), task))

    def _hand_out(self, engine: Engine) -> bool:
        """Give out what is ready; whether anything is being done."""
        while self._ready and self._out < _IN_FLIGHT:
            task = heapq.heappop(self._ready)[2]
            failed = [one for one in needed(self.plan, task) if self.records[one]["status"] not in DONE]
            if failed:
                self._end(task, {"task": task.name, "status": SKIPPED, "error": f"{task.name}: {failed[0]} failed"})
                continue
            results = {
                step: [result_of(self.plan, self._tasks[name]) for name in tasks_named(self.plan, task, step)]
                for step in task.step.needs
            }
            last = self._last(task)
            try:
                words = line_of(self.plan, task, results)
            except FacepipeError as error:
                self._end(task, {"task": task.name, "status": FAILED, "error": str(error)})
                continue
            if last is not None and self._stands(last, words):
                status = KEPT if last["status"] in DONE else FAILED
                self._end(task, {**last, "status": status}, keep=False)
                continue
            own = {"seconds": task.step.seconds, "memory_mb": task.step.memory_mb}
            limits = {name: getattr(self.options, name) if value is None else value for name, value in own.items()}
            request = {
                "task": task.name,
                "attempt": self._lost[task.name],
                "words": words,
                "last": last,
                **limits,
                "cache": self.options.cache and str(self.options.cache.absolute()),
                "cache_bytes": int(self.options.cache_gb * 1e9),
                "verify": self.options.verify,
            }
            self._out += 1
            engine.submit(request, task.order, self._answers.put)
        return self._out > 0

    def _stands(self, last: Mapping[str, Any], words: list[str]) -> bool:
        """Whether the last record of a task still holds."""
        if last.get("words") != words or last.get("version") != __version__:
            return False
        if last["status"] == FAILED:
            states = {**last.get("reads", {})}
            return not self.options.retry_failed and not last.get("passing") and bool(states) and self._are(states)
        if last["status"] not in DONE or self.options.verify:
            return False
        if self.options.resume:
            name = next(iter(own_writes(self.plan, self._tasks[last["task"]], last)), "")
            # whether a result is; a task without one needs none
            if is_url(name):
                return self._states(name) is not None
            return not name or state_of(self.plan.folder / name) is not None
        return self._are({**last["reads"], **{path: state for path, (state, _) in last["writes"].items()}})

    def _last(self, task: Task) -> Record | None:
        """What the ledger says of a task, where all that it names is below the roots, the result among it."""
        last = self.ledger.records.get(task.name)
        if last is None or not all(map(self._reach, (*last.get("reads", ()), *last.get("writes", ())))):
            return None
        if last["status"] not in DONE:
            return last
        stands_on = own_writes(self.plan, task, last) if task.step.out else last["reads"]  # else it only says so
        return last if stands_on else None

    def _are(self, states: dict[str, Any]) -> bool:
        if None in states.values():  # a result that was gone as soon as it was there
            return False
        local = {str(self.plan.folder / name): state for name, state in states.items() if not is_url(name)}
        others = ((name, tuple(state)) for name, state in states.items() if is_url(name))
        return unchanged(local) and all(self._states(url) == state for url, state in others)

    def _answered(self, record: Record) -> None:
        task = self._tasks[record["task"]]
        self.warnings |= dict.fromkeys(record.pop("warnings", ()))
        self.gone = record.get("gone", "")
        if self.gone:
            return
        if record["status"] == LOST:
            with contextlib.suppress(FacepipeError, OSError):
                result = result_of(self.plan, task)
                if result and not is_url(result) and self._reach(result):
                    collect((self.plan.folder / result).parent)
                    discard_lock(self.plan.folder / result)
        again = record["status"] == LOST or record.get("passing", False)
        self._lost[task.name] += again
        if again and self._lost[task.name] <= self.options.failures:
            self._make_ready(task)
            return
        status = FAILED if record["status"] == LOST else record["status"]
        self._end(task, {**record, "status": status, "lost": self._lost[task.name]})

    def _end(self, task: Task, record: Record, *, keep: bool = True) -> None:
        self.records[task.name] = record
        self._states.learn(record.get("writes") or {})
        if keep and record["status"] != SKIPPED:
            self.ledger.add(record)
        self.on_task(task, record)
        for name in self._for.pop(task.name, ()):
            self._waits[name] -= 1
            if self._waits[name] == 0:
                self._make_ready(self._tasks[name])


def own_writes(plan: Plan, task: Task, record: Mapping[str, Any]) -> list[str]:
    """Of the files that a record names those that are a task's own result, or in it where that is a folder."""
    result = result_of(plan, task) if task.step.out else ""
    return [name for name in record.get("writes", ()) if result and (name == result or name.startswith(f"{result}/"))]
