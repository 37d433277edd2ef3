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
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arguments import add_common
from children import Json, is_side, peak_memory, run_side
from tables import aligned, mib, ms, times

if TYPE_CHECKING:
    from facepipe.parts import FaceParts

_HERE = Path(__file__).resolve().parent
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
Row = tuple[str, str, str, str, str, str, str]
_TIMES = (
    ("session_s", "session: read, pair, factor the neutral"),
    ("first_s", "first solve of everything"),
    ("cold_s", "cold: both"),
    ("factor_s", "  of it in factors"),
    ("neutral_s", "warm neutral"),
    ("shapes_s", "warm neutral and all shapes"),
)
_RIGHT_SIDES = (
    ("neutral_rhs_s", "a right-hand side of the neutral"),
    ("shape_rhs_s", "a right-hand side of a shape"),
)
_MEMORY = (
    ("peak_bytes", "peak memory of the cold solve"),
    ("own_bytes", "  the same over the memory after imports"),
)
_WHOLE = (
    ("open_s", "facepipe blend: open and read"),
    ("solve_s", "facepipe blend: session and solve"),
    ("author_s", "facepipe blend: measure and author"),
    ("save_s", "facepipe blend: save"),
    ("whole_s", "facepipe blend, all of it"),
)
SEEDS = (1, 2)  # of the two ICT identities
STRONGER = 1.25  # shapes of the second face: ICT's are the same on every identity, which leaves nothing to reconcile
WARM_NEUTRALS, WARM_SOLVES = 40, 6  # an even number: they alternate between two sets of weights
_CHANNELS = 3  # right-hand sides of a solve: x, y and z


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
    run_side(__file__, "prepare", kind, source, *stages, report)
    solvers = (OURS, PEER, RECORDED)
    arrays = {solver: folder / f"{solver}.npz" for solver in solvers}
    samples: dict[str, list[Json]] = {side: [] for side in (*solvers, "whole")}
    for run in range(runs):
        for solver in solvers:
            solved = run_side(__file__, "solve", *stages, solver, arrays[solver], report)
            samples[solver].append(solved)
        out = folder / f"out{run}.usdc"
        samples["whole"].append(run_side(__file__, "whole", *stages, out, report))
    best = {side: _best(of_side) for side, of_side in samples.items()}
    off = run_side(__file__, "compare", arrays[OURS], arrays[PEER], report)
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


def table(result: Json) -> str:
    """One table for people: a row a figure, the ratio always splu / facepipe; what was skipped below."""
    rows: list[Row] = [("faces", "figure", "facepipe", "splu", "ratio", "splu default", "aim")]
    for face in result["faces"]:
        rows += _rows(face, result["aims"])
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    runs = result["runs"]
    return "\n".join([*aligned(rows), *skipped, f"best of {runs} run{'s' * (runs > 1)}, ratio = splu / facepipe"])


def _rows(face: Json, aims: Json) -> list[Row]:
    name, best, met = face["name"], face["best"], face["within_aims"]
    rows: list[Row] = []
    for key, text in (*_TIMES, *_RIGHT_SIDES, *_MEMORY):
        show = mib if (key, text) in _MEMORY else _ms2 if (key, text) in _RIGHT_SIDES else ms
        own, peer, recorded = (show(best[side][key]) for side in ("cholespy", "splu", "splu-default"))
        rows.append((name, text, own, peer, times(face["ratios"].get(key)), recorded, _aim(key, aims, met)))
    whole = best["whole"]
    rows += [_single(name, text, ms(whole[key])) for key, text in _WHOLE]
    rows += [
        _single(name, "facepipe blend: peak memory", mib(whole["peak_bytes"])),
        _single(name, "largest step at a border of moving points", f"{whole['border_step_mm']:.4f} mm"),
    ]
    if whole["jaw_open_step_mm"] is not None:
        rows.append(_single(name, "  of jawOpen", f"{whole['jaw_open_step_mm']:.4f} mm"))
    rows += [
        _single(name, f"largest difference of the solvers' {key}", f"{off:.1e} mm")
        for key, off in face["difference_mm"].items()
    ]
    ours = best["cholespy"]
    return [*rows, *(_single(name, f"holds {key}", f"{ours[key]:,.0f}") for key in ("points", "shapes"))]


def _single(name: str, text: str, value: str) -> Row:
    return name, text, value, "", "", "", ""


def _ms2(seconds: float) -> str:
    return f"{seconds * 1000:,.3f} ms"


def _aim(key: str, aims: Json, met: Json) -> str:
    """What a figure should reach, and whether it does."""
    if met.get(key) is None:
        return ""
    if key in ("neutral_rhs_s", "shape_rhs_s"):
        text = f"{aims['rhs_speedup']:g}x"
    else:
        text = f"{aims[key] / 1e6:g} MB" if key == "peak_bytes" else ms(aims[key])
    return text if met[key] else f"{text}: missed"


@dataclass
class Clock:
    """Seconds spent inside factors while it runs."""

    factoring: float = 0.0
    solving: float = 0.0


@dataclass
class TimedFactor:
    """A factor whose solves count."""

    factor: Any
    clock: Clock = field(repr=False)

    def solve(self, right: Any) -> Any:
        """What the factor gives."""
        start = time.perf_counter()
        result = self.factor.solve(right)
        self.clock.solving += time.perf_counter() - start
        return result


class _DefaultOrdering:
    """SuperLU as scipy calls it without options."""

    def __init__(self, matrix: Any) -> None:
        from scipy.sparse.linalg import splu

        self._factor = splu(matrix.tocsc())

    def solve(self, right: Any) -> Any:
        return self._factor.solve(right)


def timed_factors(default_ordering: bool) -> Clock:
    """The clock of every factor that blends make from here on."""
    from facepipe.geometry import gradient_system
    from facepipe.geometry.factor import Factor, Solver, factorise

    clock = Clock()

    def timed(matrix: Any, solver: Solver = "auto", *, ordered: bool = False) -> TimedFactor:
        start = time.perf_counter()
        if default_ordering and matrix.shape[0]:
            factor: Factor = _DefaultOrdering(matrix)
        else:
            factor = factorise(matrix, solver, ordered=ordered)
        clock.factoring += time.perf_counter() - start
        return TimedFactor(factor, clock)

    gradient_system.factorise = timed  # type: ignore[attr-defined]
    return clock


def prepare(kind: str, source: str, first: str, second: str) -> Json:
    """Two faces of one topology as stages."""

    from facepipe import importers
    from facepipe.heads import make
    from facepipe.importers.ict import Options
    from facepipe.stage import save_parts

    for number, (seed, out) in enumerate(zip(SEEDS, (first, second), strict=True)):
        if kind == "ict":
            parts = importers.load("ict", source, Options(identity_seed=seed)).parts
        else:
            parts = make(5 * number, controls="bones")
        save_parts(_stronger(parts, STRONGER**number), out)
    return {}


def _stronger(parts: FaceParts, factor: float) -> FaceParts:
    """The face with all offsets of its shapes times `factor`; normal offsets and inbetweens go."""
    meshes = [
        replace(
            mesh,
            blendshapes=tuple(
                replace(shape, offsets=shape.offsets * factor, normal_offsets=None, inbetweens=())
                for shape in mesh.blendshapes
            ),
        )
        for mesh in parts.meshes
    ]
    return replace(parts, meshes=tuple(meshes))


def solve(first: str, second: str, solver: str, arrays: str) -> Json:
    """A session, its first solve of everything, and warm ones with other weights."""
    import numpy as np
    import scipy.sparse.csgraph
    import scipy.sparse.linalg
    import scipy.spatial  # noqa: F401  (else the session would)

    import facepipe
    from facepipe.verbs.blend import BlendOptions, BlendSession

    default_ordering = solver == "splu-default"
    clock = timed_factors(default_ordering)
    baseline = peak_memory()
    faces = [facepipe.open(path) for path in (first, second)]
    options = BlendOptions(solver="splu" if default_ordering else solver)  # type: ignore[arg-type]
    start = time.perf_counter()
    session = BlendSession(faces, options)
    made = time.perf_counter()
    weights = _weights(session.graph.regions)
    solution = session.solve(weights[0])
    end = time.perf_counter()
    peak, factoring = peak_memory(), clock.factoring
    neutral, in_neutral = _warm(lambda call: session.neutral(weights[call % 2]), WARM_NEUTRALS, clock)
    everything, in_everything = _warm(lambda call: session.solve(weights[call % 2]), WARM_SOLVES, clock)
    shapes = len(session.sculpts)
    np.savez(arrays, points=solution.neutral.points, offsets=np.concatenate(solution.offsets))
    return {
        "session_s": made - start,
        "first_s": end - made,
        "cold_s": end - start,
        "factor_s": factoring,
        "neutral_s": neutral,
        "shapes_s": everything,
        "neutral_rhs_s": in_neutral / _CHANNELS,
        "shape_rhs_s": (in_everything - in_neutral) / (_CHANNELS * shapes),
        "baseline_bytes": baseline,
        "peak_bytes": peak,
        "own_bytes": None if peak is None or baseline is None else peak - baseline,
        "points": len(solution.neutral.points),
        "shapes": shapes,
        "mm_per_unit": session.sources.mm_per_unit,
    }


def whole(first: str, second: str, out: str) -> Json:
    """All that `facepipe blend` does: open, blend, measure, author, save."""
    import scipy.sparse.csgraph
    import scipy.sparse.linalg
    import scipy.spatial  # noqa: F401

    import facepipe
    import facepipe.stage.face  # else the first open would
    from facepipe.verbs.blend import Blend

    start = time.perf_counter()
    faces = [facepipe.open(path) for path in (first, second)]
    regions = sorted({name for mesh in faces[0].parts().meshes for name in mesh.regions})
    faces[1].parts()
    opened = time.perf_counter()
    solved = [opened]
    with faces[0].deriving(out) as face:
        report = Blend(weights=_weights(regions)[0])(face, faces, done=lambda: solved.append(time.perf_counter()))
        authored = time.perf_counter()
    end = time.perf_counter()
    steps = {name: shape.border_step_mm for name, shape in report.shapes.items()}
    return {
        "open_s": opened - start,
        "solve_s": solved[-1] - opened,
        "author_s": authored - solved[-1],
        "save_s": end - authored,
        "whole_s": end - start,
        "border_step_mm": max(steps.values(), default=0.0),
        "jaw_open_step_mm": steps.get("jawOpen"),
        "peak_bytes": peak_memory(),
    }


def compare(first: str, second: str) -> Json:
    """The largest distances between two results, in their unit."""
    import numpy as np

    with np.load(first) as ours, np.load(second) as theirs:
        return {
            name: float(np.linalg.norm(ours[name] - theirs[name], axis=1).max(initial=0.0))
            for name in ("points", "offsets")
        }


def _warm(call: Callable[[int], object], count: int, clock: Clock) -> tuple[float, float]:
    """Seconds of a call and of what it spends inside factors, the lowest of each: what else runs only adds."""
    call(0)
    wall, inside = [], []
    for number in range(count):
        before, start = clock.solving, time.perf_counter()
        call(number + 1)
        wall.append(time.perf_counter() - start)
        inside.append(clock.solving - before)
    return min(wall), min(inside)


def _weights(regions: Sequence[str]) -> list[Any]:
    """Two sets of weights of two sources, other ones in every region."""
    from facepipe.verbs.blend import Weights

    firsts = [(1 + number) / (2 + len(regions)) for number in range(len(regions))]
    rows = {name: (first, 1.0 - first) for name, first in zip(regions, firsts, strict=True)}
    return [Weights(regions=rows), Weights(regions={name: row[::-1] for name, row in rows.items()})]


if __name__ == "__main__":
    sides: dict[str, Callable[..., Json]] = {one.__name__: one for one in (prepare, solve, whole, compare)}
    sys.exit(0 if is_side(sides) else main())
