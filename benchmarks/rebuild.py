"""The neutral of a scanned person: seconds and true error of every point, against trimesh's non-rigid registrations.

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
from children import Json, run_side
from tables import aligned, mib, times

_SIDES = Path(__file__).resolve().with_name("rebuild_sides.py")
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_FIRST_SEED = 101  # of the people
_NEEDED = {"trimesh": ("trimesh", "rtree"), "the tests' scanner": ("pytest", "hypothesis")}
OURS = "facepipe"  # the row that all others are compared with
SIDES: dict[str, tuple[str, ...]] = {
    OURS: ("facepipe", "face"),
    "facepipe, all threads": ("facepipe", "face"),
    "facepipe, whole head": ("facepipe", "head"),
    "nricp_amberg": ("trimesh", "amberg", "default"),
    "nricp_amberg, tuned": ("trimesh", "amberg", "tuned"),
    "nricp_sumner": ("trimesh", "sumner", "default"),
    "nricp_sumner, tuned": ("trimesh", "sumner", "tuned"),
}
AIMS = {"processor_s": 5.0, "mean_mm": 1.0}  # the least that a peer's figure is of ours
Row = tuple[str, ...]
_HEADER = (
    "person",
    "side",
    "points",
    "processor",
    "ratio",
    "wall",
    "mean",
    "ratio",
    "p95",
    "narrow",
    "p95",
    "off scan",
    "memory",
)


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    arguments = _parser().parse_args(words)
    result = measure(arguments.data, arguments.identities, arguments.runs)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(table(result))
    return 0


def measure(data: Path, identities: int, runs: int) -> Json:
    """All figures of all people.

    :raises ChildError: a side fails
    """
    skipped = _skipped(data)
    sides = {side: words for side, words in SIDES.items() if words[0] not in skipped}
    people: list[Json] = []
    if not set(skipped) - {"trimesh"}:
        with tempfile.TemporaryDirectory(prefix="facepipe-benchmark-") as folder:
            seeds = range(_FIRST_SEED, _FIRST_SEED + identities)
            people = [_person(seed, data, Path(folder), sides, runs) for seed in seeds]
    means = {side: _mean([person["best"][side] for person in people]) for side in sides} if people else {}
    return {
        "benchmark": "rebuild",
        "runs": runs,
        "aims": AIMS,
        "machine": {"system": platform.platform(), "cpus": os.cpu_count(), "python": platform.python_version()},
        "people": people,
        "means": means,
        "ratios": {side: _ratios(figures, means[OURS]) for side, figures in means.items()},
        "skipped": skipped,
    }


def _person(seed: int, data: Path, folder: Path, sides: dict[str, tuple[str, ...]], runs: int) -> Json:
    """All sides in turn, so that they meet the same noise."""
    task, report = folder / "task.npz", folder / "report.json"
    made = run_side(_SIDES, "prepare", str(seed), data, task, report)
    samples: dict[str, list[Json]] = {side: [] for side in sides}
    for _ in range(runs):
        for side, words in sides.items():
            _set_threads("all threads" in side)
            samples[side].append(run_side(_SIDES, *words, task, report))
    return {**made, "samples": samples, "best": {side: _best(of_side) for side, of_side in samples.items()}}


def _set_threads(every: bool) -> None:
    """Of children to come."""
    for name in _THREADS:
        if every:
            os.environ.pop(name, None)
        else:
            os.environ[name] = "1"


def _best(samples: Sequence[Json]) -> Json:
    """The lowest of every figure: what else runs on a machine only adds."""
    return {key: min(sample[key] for sample in samples) for key in samples[0] if samples[0][key] is not None}


def _mean(samples: Sequence[Json]) -> Json:
    """Of all people."""
    numbers = (key for key, value in samples[0].items() if not isinstance(value, str))
    return {key: sum(sample[key] for sample in samples) / len(samples) for key in numbers}


def _ratios(theirs: Json, ours: Json) -> Json:
    return {key: theirs[key] / ours[key] for key in ours if ours[key] and key in theirs}


def _skipped(data: Path) -> dict[str, str]:
    """What is not there, with the reason."""
    skipped = {}
    ict = data / "ict_facekit" / "ict_facekit.npz"
    if not ict.is_file():
        skipped["ICT-FaceKit"] = f"no {ict}"
    for name, modules in _NEEDED.items():
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        if missing:
            skipped[name] = f"{' and '.join(missing)} not installed"
    return skipped


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_common(parser, 1, "best")
    parser.add_argument("--identities", type=positive, default=2, help="people (default 2)")
    return parser


def table(result: Json) -> str:
    """One table for people: a row a side, ratios always side / facepipe; what was skipped below."""
    rows: list[Row] = [_HEADER]
    for person in result["people"]:
        rows += _rows(str(person["seed"]), person["best"], {})
    rows += _rows("mean", result["means"], result["ratios"])
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    legend = "true errors and distances in mm, ratio = side / facepipe"
    runs = result["runs"]
    return "\n".join([*aligned(rows), *_aims(result), *skipped, f"best of {runs} run{'s' * (runs > 1)}; {legend}"])


def _rows(name: str, sides: Json, ratios: Json) -> list[Row]:
    rows = []
    for side, one in sides.items():
        ratio = ratios.get(side, {})
        rows.append(
            (
                name,
                side,
                f"{one['points']:,.0f}",
                f"{one['processor_s']:,.1f} s",
                times(ratio.get("processor_s")),
                f"{one['wall_s']:,.1f} s",
                f"{one['mean_mm']:.3f}",
                times(ratio.get("mean_mm")),
                f"{one['p95_mm']:.2f}",
                f"{one['narrow_mean_mm']:.3f}",
                f"{one['narrow_p95_mm']:.2f}",
                f"{one['surface_mm']:.3f}",
                mib(one.get("peak_bytes")),
            )
        )
    return rows


def _aims(result: Json) -> list[str]:
    """Which peers are met by what they should be."""
    lines = []
    for key, text in (("processor_s", "time"), ("mean_mm", "mean error")):
        peers = {side: ratio[key] for side, ratio in result["ratios"].items() if side.startswith("nricp")}
        missed = [f"{side} {ratio:.1f}x" for side, ratio in peers.items() if ratio < result["aims"][key]]
        if peers:
            verdict = f"missed against {', '.join(missed)}" if missed else "met"
            lines.append(f"aim, {text} of peers {result['aims'][key]:g}x ours or more: {verdict}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
