"""Blends of real faces: cold and warm seconds, seconds a right-hand side and peak memory, against scipy's splu.

Prints one table; --json writes every sample. README.md beside says what each figure means. Standard library only, so
that this process stays small: the sides are measured in children.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from arguments import add_common
from blend_table import table
from children import Json, run_child

_HERE = Path(__file__).resolve().parent
_CHILD = _HERE / "facepipe_blend.py"
OURS = "cholespy"
PEER = "splu"
RECORDED = "splu-default"  # for the record: what `splu(matrix)` gives without options
_RATIOS = (
    "cold_s",
    "factor_s",
    "neutral_s",
    "shapes_s",
    "neutral_rhs_s",
    "shape_rhs_s",
    "peak_bytes",
    "own_bytes",
)
AIMS = {"neutral_s": 0.010, "shapes_s": 0.4, "cold_s": 10.0, "rhs_speedup": 5.0, "peak_bytes": 1e9}
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    arguments = _parser().parse_args(words)
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # of the children
    result = measure(arguments.data, arguments.runs)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(table(result))
    return 0


def measure(data: Path, runs: int) -> Json:
    """All figures: of ICT-FaceKit where it is there, otherwise of the sample heads.

    :raises ChildError: a side fails
    """
    ict = data / "ict_facekit" / "ict_facekit.npz"
    found = ("ICT-FaceKit", "ict", ict) if ict.is_file() else ("samples", "sample", _HERE)
    with tempfile.TemporaryDirectory(prefix="facepipe-benchmark-") as folder:
        face = _face(*found, Path(folder), runs)
    return {
        "benchmark": "blend",
        "runs": runs,
        "aims": AIMS,
        "machine": {"system": platform.platform(), "cpus": os.cpu_count(), "python": platform.python_version()},
        "faces": [face],
        "skipped": {} if ict.is_file() else {"ICT-FaceKit": f"no {ict}"},
    }


def _face(name: str, kind: str, source: Path, folder: Path, runs: int) -> Json:
    """Two faces blended by all sides in turn, so that all meet the same noise."""
    report, stages = folder / "report.json", [folder / "first.usdc", folder / "second.usdc"]
    run_child(sys.executable, _CHILD, "prepare", kind, source, *stages, report)
    solvers = (OURS, PEER, RECORDED)
    arrays = {solver: folder / f"{solver}.npz" for solver in solvers}
    samples: dict[str, list[Json]] = {side: [] for side in (*solvers, "whole")}
    for run in range(runs):
        for solver in solvers:
            solved = run_child(sys.executable, _CHILD, "solve", *stages, solver, arrays[solver], report)
            samples[solver].append(solved)
        out = folder / f"out{run}.usdc"
        samples["whole"].append(run_child(sys.executable, _CHILD, "whole", *stages, out, report))
    best = {side: _best(of_side) for side, of_side in samples.items()}
    off = run_child(sys.executable, _CHILD, "compare", arrays[OURS], arrays[PEER], report)
    ratios = {key: _ratio(best[PEER][key], best[OURS][key]) for key in _RATIOS}
    return {
        "name": name,
        "samples": samples,
        "best": best,
        "ratios": ratios,
        "difference_mm": {key: value * best[OURS]["mm_per_unit"] for key, value in off.items()},
        "within_aims": _within(best[OURS], ratios),
    }


def _within(ours: Json, ratios: Json) -> dict[str, bool | None]:
    """Whether each aim is met; None where the figure is not known."""
    figures = {key: ours[key] for key in AIMS if key in ours}
    met: dict[str, bool | None] = {key: None if own is None else own <= AIMS[key] for key, own in figures.items()}
    return met | {key: (ratios[key] or 0.0) >= AIMS["rhs_speedup"] for key in ("neutral_rhs_s", "shape_rhs_s")}


def _ratio(theirs: float | None, ours: float | None) -> float | None:
    return theirs / ours if theirs and ours else None


def _best(samples: Sequence[Json]) -> Json:
    """The lowest of every figure: what else runs on a machine only adds."""
    known = {key: [sample[key] for sample in samples if sample[key] is not None] for key in samples[0]}
    return {key: min(values, default=None) for key, values in known.items()}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_common(parser, 3, "best")
    return parser


if __name__ == "__main__":
    sys.exit(main())
