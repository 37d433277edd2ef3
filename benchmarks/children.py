"""Child processes of the benchmarks: each measured side runs alone, so that its peak memory is its own.

Standard library only: it also runs inside Blender's Python. The parent must stay small too, since some systems count
a parent's peak for the children it starts.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

Json = dict[str, Any]
WARM_CALLS = 5  # export calls of a process after its first

_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PXR_PLUGINPATH_NAME")  # belong to the environment of the parent


class ChildError(Exception):
    """A child process failed; the message is its last line."""


def run_child(python: str, script: Path, *arguments: str | Path) -> Json:
    """What `script` reports, run by the interpreter `python`; the path of its report is its last argument.

    :raises ChildError: it can't be started, fails or reports nothing
    """
    report = Path(arguments[-1])
    report.unlink(missing_ok=True)
    own = Path(python) == Path(sys.executable)
    environment = {key: value for key, value in os.environ.items() if own or key not in _FOREIGN}
    command = [python, str(script), *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    except OSError as error:
        raise ChildError(f"{python}: {error.strerror or error}") from error
    if done.returncode or not report.is_file():
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}, no report"]
        raise ChildError(f"{script.name}: {lines[-1]}")
    result: Json = json.loads(report.read_text(encoding="utf-8"))
    return result


def run_side(script: str | Path, side: str, *arguments: str | Path) -> Json:
    """What one side of a benchmark reports, as `run_child`: ``SCRIPT --side SIDE ... REPORT``."""
    return run_child(sys.executable, Path(script), "--side", side, *arguments)


def is_side(sides: Mapping[str, Callable[..., Json]]) -> bool:
    """Whether this process is a child for one of the sides, which is run then."""
    if sys.argv[1:2] != ["--side"]:
        return False
    side, *arguments, report = sys.argv[2:]
    write_report(report, sides[side](*arguments))
    return True


def write_report(path: str | Path, report: Json) -> None:
    """Hand a child's figures to its parent."""
    Path(path).write_text(json.dumps(report), encoding="utf-8")


def export_times(export: Callable[[], object]) -> Json:
    """Wall and processor time (of all threads) of the first call of the process, and medians of those that follow.

    The peak memory is that of the first call.
    """
    wall, processor = [], []
    peak = None
    for call in range(1 + WARM_CALLS):
        cpu, start = time.process_time(), time.perf_counter()
        export()
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - cpu)
        if call == 0:
            peak = peak_memory()
    return {
        "export_s": wall[0],
        "export_cpu_s": processor[0],
        "again_s": statistics.median(wall[1:]),
        "again_cpu_s": statistics.median(processor[1:]),
        "peak_bytes": peak,
    }


def peak_memory() -> int | None:
    """Peak resident memory of this process so far in bytes; None where the system doesn't say (Windows)."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
