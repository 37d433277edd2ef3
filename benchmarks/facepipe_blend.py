"""Child of blend.py: prepares faces, solves a blend in one process, or runs the whole of it; reports times and memory.

usage: facepipe_blend.py prepare ict|sample SOURCE FIRST SECOND REPORT
       facepipe_blend.py solve FIRST SECOND cholespy|splu|splu-default ARRAYS REPORT
       facepipe_blend.py whole FIRST SECOND OUT REPORT
       facepipe_blend.py compare ARRAYS ARRAYS REPORT
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from children import Json, peak_memory, write_report

if TYPE_CHECKING:
    from facepipe.parts import FaceParts

SEEDS = (1, 2)  # of the two ICT identities
STRONGER = 1.25  # shapes of the second face: ICT's are the same on every identity, which leaves nothing to reconcile
WARM_NEUTRALS, WARM_SOLVES = 40, 6  # an even number: they alternate between two sets of weights
_CHANNELS = 3  # right-hand sides of a solve: x, y and z


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
    from facepipe.geometry.factor import Solver, factorise

    clock = Clock()

    def timed(matrix: Any, solver: Solver = "auto") -> TimedFactor:
        start = time.perf_counter()
        factor = _DefaultOrdering(matrix) if default_ordering and matrix.shape[0] else factorise(matrix, solver)
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


def main(arguments: list[str]) -> None:
    """Run the verb, report to the last argument."""
    verb, *rest, report = arguments
    verbs: dict[str, Callable[..., Json]] = {"prepare": prepare, "solve": solve, "whole": whole, "compare": compare}
    write_report(report, verbs[verb](*rest))


if __name__ == "__main__":
    main(sys.argv[1:])
