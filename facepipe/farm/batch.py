"""A plan run from end to end: its tasks, and the report."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from facepipe.core import __version__
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written, roots_of, trust
from facepipe.core.policy.urls import checked, is_url
from facepipe.declare import check_ranges
from facepipe.farm.child import Engine, Processes
from facepipe.farm.cluster import Cluster
from facepipe.farm.ledger import ledger_in
from facepipe.farm.options import RunOptions
from facepipe.farm.plan import Plan, Step, plan_of, read_plan
from facepipe.farm.report import BatchReport, report_of, write_report
from facepipe.farm.run import Run
from facepipe.stage.files import SUFFIXES

THUMBNAIL = "thumbnail"  # the step that draws each face for the report
_SIZES = range(16, 1025)
_MOST_A_CORE, _MOST_ON_HOSTS = 4, 1024  # processes: more only wait, and each takes memory


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
        run = Run(plan=plan, ledger=ledger, options=options, on_task=lambda *_: None, roots=_roots(plan, state))
        if on_task is not None:
            run.on_task = on_task(run)
        setting = _setting(plan, state, models, options)
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


def _roots(plan: Plan, state: Path) -> tuple[Path, ...]:
    return (*(trust().roots or roots_of(plan.folder / "plan")), state)


def _setting(plan: Plan, state: Path, models: bool, options: RunOptions) -> Mapping[str, Any]:
    """What processes that do tasks need to know first."""
    folders = [*dict.fromkeys(str(one.absolute()) for one in _roots(plan, state))]
    local = {"local": options.local and str(options.local.absolute()), "local_bytes": int(options.local_gb * 1e9)}
    setting = {"folder": str(plan.folder), "roots": folders, "urls": trust().urls, "models": models, **local}
    return {**setting, "version": __version__}


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
