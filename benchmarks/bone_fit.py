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
from collections.abc import Sequence
from pathlib import Path

from arguments import add_common, positive
from bone_fit_table import table
from children import Json, run_child

_HERE = Path(__file__).resolve().parent
_CHILD = _HERE / "facepipe_bone_fit.py"
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_SOFT = {"dem-bones": "0", "dem-bones-default": "10"}  # its constraint of translations: none fits best
_OWN = ("plain", "even")
_COMPARED = ("set_s", "set_wall_s", "mean_mm", "rms_mm", "max_mm", "mean_of_max_mm")
_SCIPY_JOINTS = 60  # not more: it takes minutes a target
AIMS = {"error": 0.6, "set": 1.0, "cold_s": 0.5, "warm_s": 0.1, "scipy": 50.0}


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
    made = run_child(sys.executable, _CHILD, "prepare", *source, str(joints), arrays, report)
    samples: dict[str, list[Json]] = {}
    for _ in range(arguments.runs):
        for dof in (9, 6):
            one = run_child(sys.executable, _CHILD, "facepipe", arrays, str(dof), report)
            samples.setdefault(f"facepipe-{dof}", []).append(one)
        for side, soft in _SOFT.items():
            if dem_bones:
                one = run_child(sys.executable, _CHILD, "dem-bones", arrays, soft, report)
                samples.setdefault(side, []).append(one)
    if arguments.scipy_targets and joints <= _SCIPY_JOINTS:
        one = run_child(sys.executable, _CHILD, "scipy", arrays, "9", str(arguments.scipy_targets), report)
        samples["scipy-9"] = [one]
    if arguments.bound:
        samples["bound-9"] = [run_child(sys.executable, _CHILD, "bound", arrays, report)]
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


if __name__ == "__main__":
    sys.exit(main())
