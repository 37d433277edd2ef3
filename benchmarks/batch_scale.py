"""What giving tasks out takes, of tasks that do nothing: seconds and bytes a task of `facepipe batch` and of Dask.

One side is `facepipe.farm.batch.Run` with a simulated engine, whose workers answer at once, and answers that are as
large as real ones. The other is a Dask scheduler in a process of its own, with a worker in another.

    python benchmarks/batch_scale.py [--tasks 100000] [--json out.json]
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from arguments import positive
from tables import aligned

from facepipe.core import __version__
from facepipe.farm.batch import _IN_FLIGHT, Run
from facepipe.farm.plan import Plan, Row, RunOptions, Step, plan_of
from facepipe.tasks import child
from facepipe.tasks.ledger import FILE, ledger_in

Json = dict[str, Any]
STEPS = 4
WORKERS = 100  # simulated
THREADS = 8  # of the Dask worker


class Simulated:
    """Workers that do a task each at a time, in no time."""

    def __init__(self) -> None:
        self._tasks: queue.PriorityQueue[Any] = queue.PriorityQueue()
        self._numbers = itertools.count()
        threading.Thread(target=self._work, daemon=True).start()

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Callable[[Json], object]) -> None:
        """Take a task."""
        self._tasks.put((order, next(self._numbers), request, done))

    def close(self) -> None:
        """There is nothing to end."""

    def _work(self) -> None:
        while True:
            taken = [self._tasks.get()]
            while len(taken) < WORKERS and not self._tasks.empty():
                taken.append(self._tasks.get())
            for _, _, request, done in taken:
                done(answer(request))


def answer(request: Mapping[str, Any], setting: object = None) -> Json:
    """The record of a task that did nothing, as large as that of an export."""
    task = request["task"]
    reads = {f"built/{task}.in": [5_000_000, 1], "limits.json": [100, 1]}
    writes = {f"built/{task}.glb": [[5_000_000, 1], "sha256:" + "0" * 64]}
    report = dict.fromkeys(("mean_mm", "rms_mm", "p95_mm", "max_mm", "seconds", "bytes", "joints"), 0.123456)
    record = {
        "task": task,
        "words": request["words"],
        "version": __version__,
        "status": "made",
        "key": "0" * 64,
        "reads": reads,
        "writes": writes,
        "report": report,
        "missed": False,
        "attribution": ["Made of ICT-FaceKit"],
        "seconds": 1.0,
        "peak_mb": 500.0,
        "verb": "export",
    }
    found: Json = json.loads(json.dumps(record))  # as it comes from a process: nothing is shared
    return found


def plan(folder: Path, tasks: int) -> Plan:
    """Steps that need each other, over as many faces as make the tasks."""
    rows = [Row(str(number), {"seed": str(number), "name": str(number)}) for number in range(tasks // STEPS)]
    steps = {}
    for number in range(STEPS):
        face = f"{{step{number - 1}}}" if number else "{seed}"
        words = ("export", face, "--limits", "limits.json")
        steps[f"step{number}"] = Step(name=f"step{number}", words=words, out=f"step{number}/{{name}}.glb")
    return plan_of("plan", folder, str(folder / "built"), rows, steps)


def run(folder: Path, tasks: int, engine: Any) -> Json:
    """Figures of the master, of a task each."""
    gc.collect()
    me = psutil.Process()
    wall, memory = time.perf_counter(), me.memory_info().rss
    processor = time.process_time()
    with ledger_in(folder) as ledger:
        one = Run(plan=plan(folder, tasks), ledger=ledger, options=RunOptions(), on_task=lambda *_: None)
        one(engine)
        held = me.memory_info().rss - memory
    count = len(one.records)
    assert count == tasks // STEPS * STEPS
    return {
        "tasks": count,
        "counts": dict(one.counts),
        "wall": (time.perf_counter() - wall) / count,
        "processor": (time.process_time() - processor) / count,
        "scheduling": one.scheduling / count,
        "bytes": held / count,
        "ledger": (folder / FILE).stat().st_size / count,
    }


def dask_setup(worker: Any) -> None:
    """Called by the Dask worker, which loads this file: its tasks do nothing."""
    child._do = answer


@contextmanager
def dask(folder: Path) -> Iterator[tuple[str, psutil.Process]]:
    """A scheduler and a worker while the block runs: the address, and the scheduler's process."""
    said = folder / "scheduler.json"
    line = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": here}
    processes = [subprocess.Popen([*line, "--no-dashboard", "--scheduler-file", str(said)], **quiet)]
    try:
        while not (said.exists() and said.read_text().endswith("}")):
            time.sleep(0.1)
        line = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(said), "--no-nanny"]
        more = ["--nthreads", str(THREADS), "--no-dashboard", "--preload", Path(__file__).stem]
        processes.append(subprocess.Popen([*line, *more, "--local-directory", str(folder)], **quiet))
        yield json.loads(said.read_text())["address"], psutil.Process(processes[0].pid)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def over_dask(folder: Path, tasks: int) -> Json:
    """Figures of a run on Dask's scheduler, of the master and of the scheduler."""
    with dask(folder) as (address, scheduler):
        engine = child.Cluster(address, {"version": __version__})
        used, peak = sum(scheduler.cpu_times()[:2]), [scheduler.memory_info().rss]
        over = threading.Event()

        def watch() -> None:
            while not over.wait(0.05):
                peak.append(scheduler.memory_info().rss)

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            found = run(folder, tasks, engine)
        finally:
            over.set()
            watcher.join()
        out = min(found["tasks"], _IN_FLIGHT)
        found |= {
            "scheduler": (sum(scheduler.cpu_times()[:2]) - used) / found["tasks"],
            "scheduler_bytes": (max(peak) - peak[0]) / out,
            "scheduler_mb": max(peak) / 1e6,
        }
        engine.close()
    return found


def main() -> None:
    """Run all sides, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=positive, default=100_000, help="of each side (default 100000)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in ("simulated", "dask"):
            (folder / name).mkdir()
        figures = {
            "simulated": run(folder / "simulated", arguments.tasks, Simulated()),
            "dask": over_dask(folder / "dask", arguments.tasks),
        }
    print("\n".join(table(figures)))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def table(figures: Mapping[str, Json]) -> list[str]:
    """Lines of the table: a column a side, figures of a task each."""
    sides = list(figures.values())
    kinds = (
        ("of a task", "wall", "wall", 1e6, "us"),
        ("of a task", "master's processor time", "processor", 1e6, "us"),
        ("of a task", "of it in Run", "scheduling", 1e6, "us"),
        ("of a task", "master's memory", "bytes", 1.0, "bytes"),
        ("of a task", "ledger", "ledger", 1.0, "bytes"),
        ("of a task", "scheduler's processor time", "scheduler", 1e6, "us"),
        ("of one that is given out", "scheduler's memory", "scheduler_bytes", 1.0, "bytes"),
    )
    rows = [("", "figure", *(f"{name}, {side['tasks']:,} tasks" for name, side in figures.items()))]
    for group, what, key, scale, unit in kinds:
        rows.append((group, what, *(f"{side[key] * scale:,.0f} {unit}" if key in side else "" for side in sides)))
    return aligned(rows)


if __name__ == "__main__":
    main()
