"""How far a plan is: a bar for each step on a terminal, lines in a log."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from facepipe.cli.show import is_quiet, note

if TYPE_CHECKING:
    from facepipe.farm.run import Run

_EVERY = 10.0  # seconds between two lines of a log


@contextlib.contextmanager
def shown() -> Iterator[Callable[[Run], Callable[..., object]]]:
    """Watches a run: called with it, and then with each task that ends and its record."""
    with contextlib.ExitStack() as ends:
        yield lambda run: _bars(run, ends) if sys.stderr.isatty() and not is_quiet() else _lines(run)


def _bars(run: Run, ends: contextlib.ExitStack) -> Callable[..., object]:
    from tqdm import tqdm

    steps = run.plan.steps
    width = max(len(one.name) for one in steps)
    counts = {one.name: 1 if one.once else len(run.plan.rows) for one in steps}
    bars: dict[str, Any] = {
        one.name: ends.enter_context(
            tqdm(total=counts[one.name], desc=f"{one.name:{width}}", position=number, file=sys.stderr)
        )
        for number, one in enumerate(steps)
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
    last = time.monotonic()
    total = len(run.plan.rows) * sum(not one.once for one in run.plan.steps) + sum(one.once for one in run.plan.steps)

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
