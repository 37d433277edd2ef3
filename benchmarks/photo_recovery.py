"""How well photo fits find people that are known: portraits of the sample face with random sliders.

usage: python benchmarks/photo_recovery.py [--faces 50] [--seed 0] [--size 256] [--noise 1] [--iterations N]
       [--no-networks] [--modes ...] [--processes 2] [--json out.json]

Each person is photographed neutral and with an expression (`tests/support/recovery_targets.py`); each photo is fitted
with the L1 terms that draw sliders and expressions to their defaults, and without. A fit is given the image and the
landmarks with noise, and nothing else. Columns, means over the faces:

  landmarks   px    68 landmarks of the fitted face under the fitted camera, from where they are; contour points found
                    on the mesh by the benchmark, not by the fit
  given       px    the same from the noisy ones that the fit was given
  sliders           error as a share of the range, of sliders that move a point of the head mesh by more than 1 mm
  geometry    mm    points of the face without expression, after rigid alignment; (posed: with it)
  expression        error of the weights of shapes that are on in the photo or in the fit
  active            sliders farther than 2 % of their range from their default; 30 of 45 are
  seconds           wall time of a fit on one thread, several fits at a time

The row "nothing fitted" has the errors of a face at its defaults. Medians and slowest in the JSON.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from arguments import positive
from tables import aligned, verdict

if TYPE_CHECKING:
    from recovery_fit import Fitted, Task

MODES = {
    "neutral": {"expressions": False, "sparse": True},
    "neutral, no sparsity": {"expressions": False, "sparse": False},
    "expression": {"expressions": True, "sparse": True},
    "expression, no sparsity": {"expressions": True, "sparse": False},
}
FIGURES = ("landmark_px", "noisy_px", "slider", "geometry_mm", "posed_mm", "expression", "active")
AIMS = {"landmark_px": 1.5, "slider": 0.08, "geometry_mm": 1.0}
EXPRESSION_AIM, SPARSER_AIM, WORSE_AIM = 1.3, 0.30, 0.05


def main() -> None:
    """Fit, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faces", type=positive, default=50, help="people (default 50)")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    parser.add_argument("--size", type=positive, default=256, help="pixels a side (default 256)")
    parser.add_argument("--noise", type=float, default=1.0, help="deviation of the landmarks, pixels (default 1)")
    parser.add_argument("--iterations", type=int, help="steps of gradient descent (default: the fit's own)")
    parser.add_argument("--no-networks", action="store_true", help="landmarks and colours of pixels only")
    parser.add_argument("--modes", choices=list(MODES), nargs="+", default=list(MODES), help="default: all")
    parser.add_argument("--processes", type=positive, default=2, help="fits at a time (default 2)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    results = fit_all(arguments)
    summary = {mode: means(fits) for mode, fits in results.items()}
    verdicts = judged(summary)
    print(table(summary))
    print()
    print("\n".join(verdicts))
    if arguments.json:
        report = {
            "faces": arguments.faces,
            "seed": arguments.seed,
            "size": arguments.size,
            "noise": arguments.noise,
            "means": summary,
            "aims": verdicts,
            "fits": {mode: [dataclasses.asdict(fit) for fit in fits] for mode, fits in results.items()},
        }
        arguments.json.write_text(json.dumps(report, indent=2, sort_keys=True), encoding="utf-8")


def fit_all(arguments: argparse.Namespace) -> dict[str, list[Fitted]]:
    """Every mode's fits, in processes of one thread each."""
    from recovery_fit import Task

    os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"})
    shared = {
        "seed": arguments.seed,
        "size": arguments.size,
        "noise": arguments.noise,
        "iterations": arguments.iterations,
        "networks": not arguments.no_networks,
    }
    tasks = [Task(number=i, **shared, **MODES[mode]) for i in range(arguments.faces) for mode in arguments.modes]
    results: dict[str, list[Fitted]] = {mode: [] for mode in arguments.modes}
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn"), initializer=_one_thread) as pool:
        for number, fit in enumerate(pool.map(_run, tasks)):
            results[arguments.modes[number % len(arguments.modes)]].append(fit)
            print(f"\r{number + 1} of {len(tasks)} fits", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return results


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _run(task: Task) -> Fitted:
    from recovery_fit import run

    return run(task)


def means(fits: Sequence[Fitted]) -> dict[str, Any]:
    """Means, medians and worst of the figures."""
    figures = [dataclasses.asdict(fit.figures) for fit in fits]
    result: dict[str, Any] = {}
    for name in (*FIGURES, "default_mm", "slider_rms"):
        values = np.array([figure[name] for figure in figures], dtype=float)
        result[name] = float(values.mean())
        result[f"{name}_median"], result[f"{name}_worst"] = float(np.median(values)), float(values.max())
    seconds = np.array([fit.seconds for fit in fits])
    result["seconds"], result["seconds_slowest"] = float(seconds.mean()), float(seconds.max())
    result["processor_s"] = float(np.mean([fit.processor for fit in fits]))
    result["nothing_slider"] = float(np.mean([fit.figures.nothing_slider for fit in fits]))
    names = sorted({name for figure in figures for name in figure["sliders"]})
    wrong = {name: [abs(figure["sliders"][name]) for figure in figures if name in figure["sliders"]] for name in names}
    result["by_slider"] = {name: float(np.mean(values)) for name, values in wrong.items()}
    return result


def judged(summary: dict[str, dict[str, Any]]) -> list[str]:
    """What was aimed at, and what came out."""
    lines = []
    for mode in ("neutral", "expression"):
        for name, aim in AIMS.items() if mode in summary else ():
            lines.append(verdict(f"{mode}: {name}", summary[mode][name], aim))
    if {"neutral", "expression"} <= set(summary):
        ratio = summary["expression"]["slider"] / summary["neutral"]["slider"]
        lines.append(verdict("slider error with expressions / neutral", ratio, EXPRESSION_AIM))
    for mode in ("neutral", "expression"):
        other = f"{mode}, no sparsity"
        if {mode, other} <= set(summary):
            fewer = 1 - summary[mode]["active"] / summary[other]["active"]
            worse = summary[mode]["landmark_px"] / summary[other]["landmark_px"] - 1
            lines.append(verdict(f"{mode}: active sliders left by sparsity", 1 - fewer, 1 - SPARSER_AIM))
            lines.append(verdict(f"{mode}: landmarks worse by sparsity", worse, WORSE_AIM))
    return lines


def table(summary: dict[str, dict[str, Any]]) -> str:
    """The figures for people."""
    cells = [("", "photos", "landmarks", "given", "sliders", "geometry", "posed", "expression", "active", "seconds")]
    first = next(iter(summary.values()))
    nothing = (f"{first['nothing_slider']:.3f}", f"{first['default_mm']:.2f} mm")
    cells.append(("", "nothing fitted", "", "", *nothing, "", "", "0.0", ""))
    for mode, one in summary.items():
        pixels = [f"{one[name]:.2f} px" for name in ("landmark_px", "noisy_px")]
        lengths = [f"{one[name]:.2f} mm" for name in ("geometry_mm", "posed_mm")]
        rest = (f"{one['expression']:.3f}", f"{one['active']:.1f}", f"{one['seconds']:.1f}")
        cells.append(("", mode, *pixels, f"{one['slider']:.3f}", *lengths, *rest))
    return "\n".join(aligned(cells))


if __name__ == "__main__":
    main()
