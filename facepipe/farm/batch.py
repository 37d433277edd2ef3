"""A plan run from end to end: its tasks, and the report."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core import __version__
from facepipe.core.atomic import together, write_bytes
from facepipe.core.errors import InputError
from facepipe.core.markup import Markup, heading, joined, page, ruled_table, tag
from facepipe.core.policy.paths import check_written, checked, is_url, roots_of, trust
from facepipe.core.reports import Report
from facepipe.declare import check_ranges
from facepipe.farm.child import Cluster, Engine, Processes
from facepipe.farm.ledger import ledger_in
from facepipe.farm.plan import Plan, RunOptions, Step, plan_of, read_plan
from facepipe.farm.run import Run
from facepipe.stage.files import SUFFIXES

if TYPE_CHECKING:
    pass

_DONE = ("made", "kept", "cached")
_MOST_FAILURES = 20  # on the terminal
_MOST_LINES = 1000  # on the page
_MOST_FIGURES = 6  # of a face
THUMBNAIL = "thumbnail"  # the step that draws each face for the report
_SIZES = range(16, 1025)
_MOST_A_CORE, _MOST_ON_HOSTS = 4, 1024  # processes: more only wait, and each takes memory


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
    failed = [record for record in run.records.values() if record["status"] not in _DONE]
    own = [one for one in failed if one["status"] != "skipped"]
    skipped = len(failed) - len(own)
    done = [record for record in run.records.values() if record["status"] in _DONE]
    left = (f"{run.gone}: {run.left} tasks are left, run it again to do them",) if run.gone else ()
    lines = Counter(one["error"] for one in own).items()
    steps: dict[str, dict[str, Any]] = {}
    for step in run.plan.steps:
        ended = [one for name, one in run.records.items() if name.partition("/")[0] == step.name]
        made = [one for one in ended if one["status"] in _DONE]
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
        warnings=(
            *run.warnings,
            *([f"{skipped} tasks were left out, since what they need failed"] if skipped else []),
        ),
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
        lost = [task for task in tasks if task["status"] not in _DONE]
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
    try:
        state.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(state, f"can't be made: {error.strerror or error}") from error
    start = time.perf_counter()
    with ledger_in(state) as ledger:
        roots = (*(trust().roots or roots_of(plan.folder / "plan")), state)
        run = Run(plan=plan, ledger=ledger, options=options, on_task=lambda *_: None, roots=roots)
        if on_task is not None:
            run.on_task = on_task(run)
        setting = {  # what processes that do tasks need to know first
            "folder": str(plan.folder),
            "roots": [*dict.fromkeys(str(one.absolute()) for one in roots)],
            "urls": trust().urls,
            "models": models,
            "local": options.local and str(options.local.absolute()),
            "local_bytes": int(options.local_gb * 1e9),
            "version": __version__,
        }
        engine: Engine = (
            Cluster(cluster, setting, processes) if cluster else Processes(processes or os.cpu_count() or 1, setting)
        )
        try:
            run(engine)
        finally:
            engine.close()
        report = report_of(run, state, time.perf_counter() - start)
        write_report(report, run, state)
    return report


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
