"""A plan run from end to end: tasks are given out once what they need is there, their records kept; the report."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import json
import os
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.atomic import collect, together, write_bytes
from facepipe.core.errors import FacepipeError, InputError, printable, system_errors
from facepipe.core.locks import discard_lock
from facepipe.core.markup import Markup, heading, joined, page, ruled_table, tag
from facepipe.core.policy.paths import Reach, check_written, checked, is_url, roots_of, trust
from facepipe.core.reports import Report
from facepipe.declare import check_ranges
from facepipe.farm.plan import (
    Plan,
    RunOptions,
    Step,
    Task,
    line_of,
    needed,
    plan_of,
    read_plan,
    result_of,
    tasks_named,
    tasks_of,
)
from facepipe.stage.files import SUFFIXES
from facepipe.tasks.child import LOST, Cluster, Engine, Processes
from facepipe.tasks.contents import state_of, unchanged
from facepipe.tasks.ledger import CACHED, FAILED, KEPT, MADE, Ledger, Record, ledger_in
from facepipe.tasks.remote import States

DONE = (MADE, KEPT, CACHED)
SKIPPED = "skipped"  # what it needs failed
_IN_FLIGHT = 10_000  # tasks that are given out at once
_MOST_FAILURES = 20  # on the terminal
_MOST_LINES = 1000  # on the page
_MOST_FIGURES = 6  # of a face
THUMBNAIL = "thumbnail"  # the step that draws each face for the report
_SIZES = range(16, 1025)
_MOST_A_CORE, _MOST_ON_HOSTS = 4, 1024  # processes: more only wait, and each takes memory

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
            task = self._tasks[record["task"]]
            self.warnings |= dict.fromkeys(record.pop("warnings", ()))
            self.gone = record.get("gone", "")
            if self.gone:
                break
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
                continue
            status = FAILED if record["status"] == LOST else record["status"]
            self._end(task, {**record, "status": status, "lost": self._lost[task.name]})
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


@dataclass(frozen=True, kw_only=True)
class BatchReport(Report):
    """The report of a plan."""

    faces: int
    tasks: int
    counts: Mapping[str, int]  # status -> tasks
    steps: Mapping[str, Mapping[str, Any]]  # step -> counts, and of what is done seconds_mean, to make it, and peak_mb
    failures: tuple[str, ...]  # a line each
    missed_checks: tuple[str, ...]  # tasks that were done, but missed a check or threshold
    attributions: tuple[str, ...]  # of everything that went in
    seconds: float
    scheduling_seconds: float  # of those, what giving tasks out took
    page: Path

    @property
    def missed(self) -> bool:
        """Whether anything was not done, or missed a check."""
        return bool(self.failures or self.missed_checks)

    def text(self) -> str:
        """The report for people."""
        counts = ", ".join(f"{count} {status}" for status, count in sorted(self.counts.items()))
        lines = [f"{self.faces} faces, {self.tasks} tasks in {self.seconds:.1f} s: {counts}"]
        for name, one in self.steps.items():
            said = ", ".join(f"{one['counts'][status]} {status}" for status in sorted(one["counts"]))
            time = f"; {one['seconds_mean']:.2f} s each" if one.get("seconds_mean") else ""
            lines.append(f"  {name}: {said}{time}")
        lines += [f"warning: {line}" for line in self.warnings]
        lines += [f"failed: {line}" for line in self.failures[:_MOST_FAILURES]]
        if len(self.failures) > _MOST_FAILURES:
            lines.append(f"and {len(self.failures) - _MOST_FAILURES} more, see the report")
        if self.missed_checks:
            lines.append(f"a check was missed: {', '.join(self.missed_checks[:_MOST_FAILURES])}")
        return "\n".join([*lines, f"report: {self.page}"])


def report_of(run: Run, state: Path, seconds: float) -> BatchReport:
    """The report of a run that has ended."""
    failed = [record for record in run.records.values() if record["status"] not in DONE]
    own = [one for one in failed if one["status"] != "skipped"]
    skipped = len(failed) - len(own)
    done = [record for record in run.records.values() if record["status"] in DONE]
    left = (f"{run.gone}: {run.left} tasks are left, run it again to do them",) if run.gone else ()
    lines = Counter(one["error"] for one in own).items()
    steps: dict[str, dict[str, Any]] = {}
    for step in run.plan.steps:
        ended = [one for name, one in run.records.items() if name.partition("/")[0] == step.name]
        made = [one for one in ended if one["status"] in DONE]
        steps[step.name] = {"counts": dict(Counter(one["status"] for one in ended))}
        if made:
            steps[step.name]["seconds_mean"] = sum(one["seconds"] for one in made) / len(made)
            steps[step.name]["peak_mb"] = max((one.get("peak_mb") or 0.0) for one in made)
    return BatchReport(
        faces=len(run.plan.rows),
        tasks=len(run.records),
        counts=dict(run.counts),
        steps=steps,
        failures=(*(f"{line} ({count} tasks)" if count > 1 else line for line, count in lines), *left),
        missed_checks=tuple(one["task"] for one in done if one.get("missed")),
        attributions=tuple(sorted({text for one in done for text in one.get("attribution") or ()})),
        seconds=seconds,
        scheduling_seconds=run.scheduling,
        page=state / "report.html",
        warnings=(*run.warnings, *([f"{skipped} tasks were left out, since what they need failed"] if skipped else [])),
    )


def write_report(report: BatchReport, run: Run, state: Path) -> None:
    """``report.json``, with every task, and ``report.html`` in the state folder.

    :raises InputError: they can't be written
    """
    tasks = [run.records[name] for name in sorted(run.records)]
    content = {**report.to_dict(), "records": tasks}
    with together(state / "report.html"):
        write_bytes(state / "report.json", json.dumps(content, sort_keys=True, indent=1, default=str).encode())
        title = Path(run.plan.where).name
        counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items()))
        facts = f"{report.faces} faces, {report.tasks} tasks: {counts}; {report.seconds:.1f} s, "
        facts += f"of which giving tasks out {report.scheduling_seconds:.1f} s"
        steps = [
            (name, ", ".join(f"{count} {status}" for status, count in sorted(figures["counts"].items())),
             f"{figures.get('seconds_mean', 0):.2f}", f"{figures.get('peak_mb', 0):.0f}")
            for name, figures in report.steps.items()
        ]  # fmt: skip
        parts = [tag("h1", title), tag("p", facts, class_="muted"), heading("Steps")]
        parts.append(ruled_table(("step", "tasks", "seconds each", "peak MB"), steps, numbers=(2, 3)))
        if report.failures:
            lines = (tag("li", tag("code", line)) for line in report.failures[:_MOST_LINES])
            parts.append(joined(tag("h2", "Not done", class_="bad"), tag("ul", *lines)))
        parts += [heading("Faces"), tag("div", *_cards(run, state), class_="cards")]
        if report.attributions:
            parts += [
                heading("Licences and attributions"),
                tag("ul", *(tag("li", line) for line in report.attributions)),
            ]
        write_bytes(state / "report.html", page(title, *parts))


def _cards(run: Run, state: Path) -> Iterator[Markup]:
    """A card for each face: picture, errors, times, what went wrong."""
    from urllib.parse import quote

    names = [step.name for step in run.plan.steps if not step.once]
    for row in run.plan.rows:
        tasks = [run.records[f"{name}/{row.name}"] for name in names if f"{name}/{row.name}" in run.records]
        written = [path for task in tasks for path in task.get("writes", ())]
        image = []
        if pictures := [path for path in written if path.endswith(".png") and not is_url(path)]:
            there = Path(os.path.relpath(run.plan.folder / pictures[-1], state.absolute()))  # as the page names it
            image = [tag("img", loading="lazy", src=quote(os.fsencode(there.as_posix())), alt="")]
        errors = {name: value for task in tasks for name, value in errors_mm(task.get("report") or {}).items()}
        seconds = sum(task.get("seconds", 0.0) for task in tasks)
        lost = [task for task in tasks if task["status"] not in DONE]
        bad = [tag("div", task["task"], class_="bad", title=task["error"]) for task in lost]
        figures = [tag("div", f"{name} {value:.3g} mm") for name, value in list(errors.items())[:_MOST_FIGURES]]
        yield tag("div", *image, tag("b", row.name), f" {seconds:.1f} s", *bad, *figures, class_="card")


def errors_mm(report: Mapping[str, Any]) -> dict[str, float]:
    """Figures in millimetres of a task's report, by name; of those in a mapping the mean and the largest alone."""
    errors: dict[str, float] = {}
    for key, value in report.items():
        if isinstance(value, Mapping):
            short = {name.removesuffix("_mm"): number for name, number in value.items()}
            unit = key.endswith("_mm") or any(name.endswith("_mm") for name in value)
            named = {f"{key.removesuffix('_mm')} {name}": short.get(name) for name in ("mean", "max")} if unit else {}
            errors |= {name: number for name, number in named.items() if isinstance(number, int | float)}
        elif key.endswith("_mm") and isinstance(value, int | float):
            errors[key.removesuffix("_mm")] = value
    return errors


def batch(
    plan: Plan | str | os.PathLike[str],
    state: str | os.PathLike[str] | None = None,
    *,
    options: RunOptions | None = None,
    processes: int | None = None,
    cluster: str | None = None,
    thumbnails: int = 0,
    models: bool = False,
    on_task: Callable[[Run], Callable[..., object]] | None = None,
) -> BatchReport:
    """Run a plan: `facepipe batch`.

    :param plan: or its file (.toml)
    :param state: folder of records, and of the report: ``report.html``, ``report.json``; made where there is none
        (default ``NAME_batch`` beside the file)
    :param processes: on this machine, or on each host of ssh (default: a core each)
    :param cluster: address of a Dask cluster that runs it instead
    :param thumbnails: pixels of the pictures in the report, 0 for none
    :param models: models that can run code are loaded
    :param on_task: called with the run; returns what is called with each task that ends and its record
    :raises InputError: no plan, options out of range, another run of the state, or a cluster that can't be used
    """
    options = options or RunOptions()
    check_ranges(options)
    most = _MOST_ON_HOSTS if cluster else _MOST_A_CORE * (os.cpu_count() or 1)
    if processes is not None and not 1 <= processes <= most:
        raise InputError("--processes", f"is {processes}, expected 1 to {most}")
    for named in (one for one in (state, options.cache, options.local) if one is not None):
        check_written(Path(named))
    if not isinstance(plan, Plan):
        state = Path(plan).absolute().parent / f"{Path(plan).stem}_batch" if state is None else state
        plan = read_plan(Path(plan))
    state = plan.folder / "facepipe_batch" if state is None else Path(state)
    check_written(state)
    for root in trust().urls:
        checked(root, [root])
    if is_url(plan.out):
        checked(plan.out, trust().urls)
    plan = _with_thumbnails(plan, state, thumbnails)
    with system_errors(state, "can't be made"):
        state.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with ledger_in(state) as ledger:
        roots = (*(trust().roots or roots_of(plan.folder / "plan")), state)
        run = Run(plan=plan, ledger=ledger, options=options, on_task=lambda *_: None, roots=roots)
        if on_task is not None:
            run.on_task = on_task(run)
        setting = _setting(plan, roots, models, options)
        engine: Engine = (
            Cluster(cluster, setting, processes) if cluster else Processes(processes or os.cpu_count() or 1, setting)
        )
        with contextlib.closing(engine):
            run(engine)
        report = report_of(run, state, time.perf_counter() - start)
        write_report(report, run, state)
    return report


def _setting(plan: Plan, roots: tuple[Path, ...], models: bool, options: RunOptions) -> Mapping[str, Any]:
    """What processes that do tasks need to know first."""
    return {
        "folder": str(plan.folder),
        "roots": [*dict.fromkeys(str(one.absolute()) for one in roots)],
        "urls": trust().urls,
        "models": models,
        "local": options.local and str(options.local.absolute()),
        "local_bytes": int(options.local_gb * 1e9),
        "version": __version__,
    }


def _with_thumbnails(plan: Plan, state: Path, size: int) -> Plan:
    """The plan with one more step, which draws the last stage of each face, or the face of the table, unless it has a
    step of that name.

    :raises InputError: a size that pictures can't have
    """
    if not size:
        return plan
    if size not in _SIZES:
        raise InputError("--thumbnails", f"is {size}, expected 0, or {_SIZES[0]} to {_SIZES[-1]} pixels")
    stages = [one.name for one in plan.steps if not one.once and Path(one.out).suffix.lower() in SUFFIXES]
    drawn = stages[-1] if stages else "face" if plan.rows and "face" in plan.rows[0].values else None
    if drawn is None or any(one.name == THUMBNAIL for one in plan.steps):
        return plan
    out = f"{state.absolute().as_posix()}/thumbnails/{{name}}.png"
    step = Step(name=THUMBNAIL, words=("render", f"{{{drawn}}}", "--size", str(size)), out=out, priority=-1)
    steps = {one.name: one for one in plan.steps} | {THUMBNAIL: step}
    found = plan_of(plan.where, plan.folder, plan.out, plan.rows, steps)
    return replace(found, faults={**plan.faults, **found.faults})
