"""Run the same steps over many faces: those of a plan, or one line for each file; here, or on a Dask cluster.

PLAN is a TOML file: a table of faces, and steps, each a line of this command line (docs/batch.md). Tasks that are
up to date are skipped; those that fail are listed, and the others go on.

Exit code 1: done, but some tasks failed, which are listed, or missed a check.

examples:
  facepipe batch show.toml
  facepipe batch show.toml --processes 8 --seconds 600 --memory-mb 2000
  facepipe batch show.toml --retry-failed
  facepipe batch show.toml --cluster tcp://farm:8786
  facepipe batch --each 'heads/*.glb' -o '{name}.usda' -- fit-bones {face} --target smile.usda
  facepipe batch --each 'heads/*.usda' -- validate {face}
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_options, options_from
from facepipe.cli.show import emit, is_quiet, note
from facepipe.core.errors import InputError
from facepipe.farm.plan import RunOptions

if TYPE_CHECKING:
    from facepipe.farm.batch import Run
    from facepipe.farm.plan import Plan

_EVERY = 10.0  # seconds between two lines of a log


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("words", nargs="*", metavar="PLAN | -- ACTION ...", help="plan (.toml); with --each the line for each file")
    add("--each", metavar="GLOB", help="files to do it to; {face} is the file, {name} its name without suffix")
    add("-o", "--output", metavar="OUT", help="with --each: the result of each, like game/{name}.glb")
    add("--state", type=Path, metavar="DIR", help="what is done, and the report (default beside the plan: NAME_batch)")
    add(
        "--processes",
        type=int,
        default=None,
        metavar="N",
        help="on this machine, or on each host of ssh (default: a core each)",
    )
    cluster = "do it on a Dask cluster: tcp://HOST:PORT of its scheduler, or ssh://HOST,HOST"
    add("--cluster", metavar="ADDRESS", help=cluster)
    add("--thumbnails", type=int, default=128, metavar="PX", help="pictures in the report, 0 for none (default 128)")
    add("--json", action="store_true", help="print the report as JSON")
    add_options(parser, RunOptions, "how tasks are run")


def run(arguments: argparse.Namespace) -> int:
    """Run the plan, print its report."""
    from facepipe.core.policy.paths import trust, trusting, typed_roots
    from facepipe.farm.plan import each, read_plan

    if arguments.each is None:
        if len(arguments.words) != 1:
            raise InputError("PLAN", f"{len(arguments.words)} words, expected one plan (or --each GLOB -- ACTION ...)")
        if arguments.output is not None:
            raise InputError("-o", "given with a plan, which says itself where results go")
        file = Path(arguments.words[0])
        return _run(arguments, read_plan(file), arguments.state or file.with_name(f"{file.stem}_batch"))
    urls = typed_roots((arguments.each, arguments.output or "", *arguments.words))
    with trusting(replace(trust(), urls=(*trust().urls, *urls))):
        return _run(arguments, each(arguments.each, arguments.words, arguments.output or ""), arguments.state)


def _run(arguments: argparse.Namespace, plan: Plan, state: Path | None) -> int:
    from facepipe.cli import in_project
    from facepipe.core.policy.paths import trust
    from facepipe.core.project import project_around
    from facepipe.farm.batch import batch
    from facepipe.farm.plan import plan_of

    project = project_around(Path.cwd())
    if project is not None:
        steps = {
            one.name: replace(one, words=tuple(in_project(project, one.words, plan.folder, one.out)))
            for one in plan.steps
        }
        plan = plan_of(plan.where, plan.folder, plan.out, plan.rows, steps)  # what a project adds can have braces too
    with contextlib.ExitStack() as ends:  # of bars
        report = batch(
            plan,
            state,
            options=options_from(arguments, RunOptions),
            processes=arguments.processes,
            cluster=arguments.cluster,
            thumbnails=arguments.thumbnails,
            models=trust().models,
            on_task=lambda run: _bars(run, ends) if sys.stderr.isatty() and not is_quiet() else _lines(run),
        )
    emit(report.to_dict(), report.text(), as_json=arguments.json)
    return 1 if report.missed else 0


def _bars(run: Run, ends: contextlib.ExitStack) -> Callable[..., object]:
    from tqdm import tqdm

    steps = run.plan.steps
    width = max(len(one.name) for one in steps)
    counts = {one.name: 1 if one.once else len(run.plan.rows) for one in steps}
    bars: dict[str, Any] = {
        step.name: ends.enter_context(
            tqdm(total=counts[step.name], desc=f"{step.name:{width}}", position=number, file=sys.stderr)
        )
        for number, step in enumerate(steps)
    }
    failed: Counter[str] = Counter()

    def on_task(task: Any, record: dict[str, Any]) -> None:
        name = task.step.name
        if record["status"] in ("failed", "skipped"):
            failed[name] += 1
            bars[name].set_postfix_str(f"{failed[name]} failed", refresh=False)
        bars[name].update()

    return on_task


def _lines(run: Run) -> Callable[..., object]:
    last, total = time.monotonic(), run.left  # none has ended

    def on_task(task: Any, record: dict[str, Any]) -> None:
        nonlocal last
        if record["status"] == "failed":
            note(f"failed: {record['error']}")
        done = len(run.records)
        if time.monotonic() - last > _EVERY or done == total:
            last = time.monotonic()
            counts = ", ".join(f"{count} {status}" for status, count in sorted(run.counts.items()))
            note(f"{done:,} of {total:,} tasks: {counts}")

    return on_task
