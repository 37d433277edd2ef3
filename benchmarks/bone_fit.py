"""Bone fits of all shapes of a face: time and error against py-dem-bones and scipy's bounded solvers.

Prints one table; --json writes every sample. README.md beside says what each figure means. Standard library only, so
that this process stays small: the sides are measured in children.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from arguments import add_common, positive
from children import Json, run_side
from tables import aligned, ms, times

_HERE = Path(__file__).resolve().parent
_SIDES = _HERE / "bone_fit_sides.py"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_SOFT = {"dem-bones": "0", "dem-bones-default": "10"}  # its constraint of translations: none fits best
_OWN = ("plain", "even")
_COMPARED = ("set_s", "set_wall_s", "mean_mm", "rms_mm", "max_mm", "mean_of_max_mm")
_SCIPY_JOINTS = 60  # not more: it takes minutes a target
AIMS = {"error": 0.6, "set": 1.0, "cold_s": 0.5, "warm_s": 0.1, "scipy": 50.0}
Row = tuple[str, ...]
_PEER, _DEFAULT = "dem-bones", "dem-bones-default"
_HEAD = ("bones", "figure", "facepipe", "evened", "py-dem-bones", "its defaults", "scipy", "ratio", "evened", "aim")
_BOUNDS = {
    "bones": "9 DOF, least squares",
    "bones-mean": "9 DOF, least mean",
    "affine": "free affine bones, least squares",
    "affine-mean": "free affine bones, least mean",
}
_BOUND_HEAD = ("bones", "how near they come", "mean", "RMS", "largest", "mean / py-dem-bones", "largest / py-dem-bones")


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    arguments = _parser().parse_args(words)
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # of the children
    result = measure(arguments)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(table(result))
    return 0


def measure(arguments: argparse.Namespace) -> Json:
    """All figures: of ICT-FaceKit where it is there, otherwise of a sample head.

    :raises ChildError: a side fails
    """
    ict = arguments.data / "ict_facekit" / "ict_facekit.npz"
    source = ("ict", ict) if ict.is_file() else ("sample", _HERE)
    skipped = {} if ict.is_file() else {"ICT-FaceKit": f"no {ict}"}
    if importlib.util.find_spec("py_dem_bones") is None:
        skipped["py-dem-bones"] = "not installed"
    tasks = []
    with tempfile.TemporaryDirectory(prefix="facepipe-benchmark-") as folder:
        for joints in arguments.joints:
            tasks += _tasks(source, joints, Path(folder), arguments, "py-dem-bones" not in skipped)
    return {
        "benchmark": "bone_fit",
        "runs": arguments.runs,
        "aims": AIMS,
        "machine": {"system": platform.platform(), "cpus": os.cpu_count(), "python": platform.python_version()},
        "face": "ICT-FaceKit" if ict.is_file() else "sample",
        "tasks": tasks,
        "skipped": skipped,
    }


def _tasks(
    source: tuple[str, Path], joints: int, folder: Path, arguments: argparse.Namespace, dem_bones: bool
) -> list[Json]:
    """A run with 9 degrees of freedom a joint and one with 6, of the same weights; the sides take turns."""
    arrays, report = folder / f"{joints}.npz", folder / "report.json"
    made = run_side(_SIDES, "prepare", *source, str(joints), arrays, report)
    samples: dict[str, list[Json]] = {}
    for _ in range(arguments.runs):
        for dof in (9, 6):
            one = run_side(_SIDES, "facepipe", arrays, str(dof), report)
            samples.setdefault(f"facepipe-{dof}", []).append(one)
        for side, soft in _SOFT.items():
            if dem_bones:
                one = run_side(_SIDES, "dem-bones", arrays, soft, report)
                samples.setdefault(side, []).append(one)
    if arguments.scipy_targets and joints <= _SCIPY_JOINTS:
        one = run_side(_SIDES, "scipy", arrays, "9", str(arguments.scipy_targets), report)
        samples["scipy-9"] = [one]
    if arguments.bound:
        samples["bound-9"] = [run_side(_SIDES, "bound", arrays, report)]
    return [_task(made, dof, samples) for dof in (9, 6)]


def _task(made: Json, dof: int, samples: dict[str, list[Json]]) -> Json:
    own = samples[f"facepipe-{dof}"]
    sides = {name: _best([one[name] for one in own]) for name in _OWN}
    sides |= {side: _best(samples[side]) for side in _SOFT if side in samples}
    scipy, bound = (samples.get(f"{name}-{dof}", [None])[0] for name in ("scipy", "bound"))
    ratios: Json = {}
    for peer in (side for side in _SOFT if side in sides):
        ratios[peer] = {
            name: {key: sides[name][key] / sides[peer][key] for key in _COMPARED if sides[peer][key]} for name in _OWN
        }
    linear = sides["plain"]["linear_s"]
    if scipy is not None:
        ratios["scipy"] = {
            "cold": scipy["cold_s"] / scipy["ours_cold_s"],
            "linear": scipy["linear_s"] / linear,
            "rms": scipy["ours"]["rms_mm"] / scipy["rms_mm"] if scipy["rms_mm"] else None,
        }
    found = {"samples": own, "best": sides, "linear_s": linear, "scipy": scipy, "bound": bound, "ratios": ratios}
    return {**made, "dof": dof, **found}


def _best(samples: Sequence[Json]) -> Json:
    """The lowest of every figure: what else runs on a machine only adds."""
    return {key: min(sample[key] for sample in samples) for key in samples[0]}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_common(parser, 3, "best")
    parser.add_argument("--joints", type=positive, nargs="+", default=[60, 150], help="default 60 150")
    parser.add_argument("--scipy-targets", type=int, default=2, help="hardest targets for scipy, 0: none (default 2)")
    parser.add_argument("--bound", action="store_true", help="also how near any bones could come (takes minutes)")
    return parser


def table(result: Json) -> str:
    """One table for people: a row a figure, ratios always facepipe / py-dem-bones; what was skipped below."""
    rows: list[Row] = [_HEAD]
    for task in result["tasks"]:
        rows += _rows(task, result["aims"])
    bounds = [row for task in result["tasks"] if task["bound"] is not None for row in _bounds(task)]
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    made, runs = result["tasks"][0], result["runs"]
    note = f"{result['face']}: {made['points']} points, {made['targets']} targets, {made['influences']} influences"
    lines = [*aligned(rows), *skipped]
    lines.append(f"{note}; best of {runs} run{'s' * (runs > 1)}, processor time, ratio = facepipe / py-dem-bones")
    return "\n".join([*lines, "", *aligned([_BOUND_HEAD, *bounds])] if bounds else lines)


def _rows(task: Json, aims: Json) -> list[Row]:
    name = f"{task['joints']} joints, {task['dof']} DOF"
    nine, single = task["dof"] == 9, task["joints"] <= 60  # whom the aims are for
    error, whole_aim = (aims["error"], aims["set"]) if nine else (None, None)
    cold, warm = (aims["cold_s"], aims["warm_s"]) if single else (None, None)
    errors = [
        _row(name, "mean error", "mean_mm", task, mm, error),
        _row(name, "largest error", "max_mm", task, mm, error),
        _row(name, "  of a target, mean", "mean_of_max_mm", task, mm, None),
    ]
    whole = [
        _row(name, f"all {task['targets']} targets", "set_s", task, ms, whole_aim),
        _row(name, "  wall time", "set_wall_s", task, ms, None),
    ]
    singles = [
        _single(name, "a fit from rest, median", "cold_s", task, cold),
        _single(name, "  slowest", "cold_slowest_s", task, None),
        _single(name, "a fit from the frame before, median", "warm_s", task, warm),
        _single(name, "  slowest", "warm_slowest_s", task, None),
    ]
    return [*errors, *whole, *singles, *_scipy(name, task, aims)]


def _row(name: str, text: str, key: str, task: Json, show: Callable[[float | None], str], aim: float | None) -> Row:
    """A figure that the peer has too."""
    best, ratios = task["best"], task["ratios"].get(_PEER)
    cells = [show(best.get(side, {}).get(key)) for side in ("plain", "even", _PEER, _DEFAULT)]
    own = [None if ratios is None else ratios[side].get(key) for side in ("plain", "even")]
    known = [one for one in own if one is not None]
    met = "" if aim is None or not known else f"{aim:g}x" + ("" if min(known) <= aim else ": missed")
    scipy = "" if key != "set_s" or task["scipy"] is None else f"({show(task['scipy'][key])})"
    return name, text, *cells, scipy, *(times(one) for one in own), met


def _single(name: str, text: str, key: str, task: Json, aim: float | None) -> Row:
    best = task["best"]
    own = best["plain"][key]
    met = "" if aim is None else ms(aim) + ("" if own <= aim else ": missed")
    return name, text, ms(own), ms(best["even"].get(key)), "", "", "", "", "", met


def _scipy(name: str, task: Json, aims: Json) -> list[Row]:
    scipy = task["scipy"]
    if scipy is None:
        return []
    ratios, count = task["ratios"]["scipy"], scipy["targets"]
    met = f"{aims['scipy']:g}x"
    rows: list[Row] = []
    for text, own, key in (
        (f"the {count} hardest targets, from rest: scipy / facepipe", scipy["ours_cold_s"], "cold"),
        ("one boxed linear system: scipy / facepipe", task["linear_s"], "linear"),
    ):
        missed = "" if ratios[key] >= aims["scipy"] else ": missed"
        rows.append((name, text, ms(own), "", "", "", ms(scipy[f"{key}_s"]), times(ratios[key]), "", met + missed))
    rms = (mm(scipy["ours"]["rms_mm"]), "", "", "", mm(scipy["rms_mm"]))
    return [*rows, (name, "  RMS error of these targets", *rms, "", "", "")]


def _bounds(task: Json) -> list[Row]:
    bound, peer, name = task["bound"], task["best"].get(_PEER), f"{task['joints']} joints"
    rows = []
    for side, text in _BOUNDS.items():
        errors = bound["sides"][side]
        ratios = [None if peer is None else errors[key] / peer[key] for key in ("mean_mm", "max_mm")]
        rows.append((name, text, *(mm(errors[f"{key}_mm"]) for key in ("mean", "rms", "max")), *map(times, ratios)))
    least = bound["least_mean_mm"]
    ratio = None if peer is None else least / peer["mean_mm"]
    return [*rows, (name, "no bones go below", mm(least), "", "", times(ratio), "")]


def mm(value: float | None) -> str:
    """Millimetres."""
    return "" if value is None else f"{value:.4f} mm"


if __name__ == "__main__":
    sys.exit(main())
