"""How near a neural rig comes to the rig that it learns, and a rig carried to another person to that person's.

The teacher is a MakeHuman head with bones, expressions, correctives and quaternion-driven shapes (neural_rig_teacher).
Every figure is of frames drawn by another seed than those that are learned. Peers: blendshapes of least squared error,
and ridge regression to principal components; for other persons, the first one's deltas, and deformation transfer.

    python benchmarks/neural_rig.py
    python benchmarks/neural_rig.py --persons 1 --json neural_rig.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import add_common
from neural_rig_teacher import HEAD, Teacher, person, teacher
from tables import aligned

if TYPE_CHECKING:
    from facepipe.neural import Motion
    from facepipe.rig.neural_rig import NeuralRig

PERSONS = (
    {"macro/african-male-old": 1.0, "nose/nose-greek-incr": 0.6, "head/head-fat-incr": 0.5},
    {"macro/asian-female-young": 1.0, "head/head-oval": 0.7, "chin/chin-prominent-decr": 0.6},
    {"macro/caucasian-male-young": 1.0, "head/head-square": 0.8, "nose/nose-flaring-incr": 0.7},
)
FRAMES = 100  # of a person


@dataclass(frozen=True)
class Row:
    """One way to make frames that were not learned."""

    of: str
    way: str
    mean_mm: float
    max_mm: float | None = None
    kilobytes: float | None = None  # float32
    ms: float | None = None  # a frame in numpy


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 5, "the median")
    parser.add_argument("--persons", type=int, default=len(PERSONS), help=f"other people, up to {len(PERSONS)}")
    parser.add_argument("--spread", type=int, default=3000, help="frames to learn that move many controls")
    arguments = parser.parse_args()
    if not (arguments.data / HEAD).exists():
        print(f"{arguments.data / HEAD}: not there, nothing to measure", file=sys.stderr)
        return 0
    first = teacher(arguments.data)
    rows, rig, share = _forward(first, arguments)
    for number, targets in enumerate(PERSONS[: arguments.persons]):
        second = person(first, arguments.data, targets, seed=number)
        rows += _carried(rig, second, f"person {number + 1}")
        if not number:
            rows += _without_controls(rig, second, "person 1, best controls")
    print("\n".join(aligned([("frames of", "by", "mean mm", "max mm", "KB", "ms"), *map(_cells, rows)])))
    print(f"of the teacher's motion {100.0 * share:.1f} % is not straight in its controls (RMS)")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": [asdict(row) for row in rows], "not_straight": share}, indent=2))
    return 0


def _forward(first: Teacher, arguments: argparse.Namespace) -> tuple[list[Row], NeuralRig, float]:
    """The rows of the teacher's own frames, the neural rig with bones, and how much is not straight."""
    from facepipe.neural import SampleMotionOptions, TrainNeuralRig, TrainNeuralRigOptions
    from facepipe.neural.train_neural_rig import best_blendshapes, ridge

    learned = first.motion(SampleMotionOptions(spread=arguments.spread, sweep=6, together=2000))
    unseen = first.motion(SampleMotionOptions(spread=300, sweep=0, together=300, seed=2026))
    train = TrainNeuralRig(options=TrainNeuralRigOptions(influences=0))
    rig = train(learned).rig
    alone = train(replace(learned, bones=None, coefficients=None)).rig
    straight, components = best_blendshapes(learned), ridge(learned, 0.01, 128)
    points, controls = len(learned.rest), len(first.controls)
    rows = [
        _row("teacher", "neural rig", rig.points, unseen, _size(rig)),
        _row("teacher", "neural rig without bones", alone.points, unseen, _size(alone)),
        _row("teacher", "best blendshapes", straight.points, unseen, 12 * points * controls),
        _row("teacher", "components and ridge", components.points, unseen, 4 * 128 * (3 * points + controls)),
        _row("teacher", "the rig itself", _evaluation(first), unseen, None),
    ]
    left = np.stack([straight.points(value) for value in unseen.values]) - unseen.points
    return rows, rig, float(np.sqrt(np.square(left).sum() / np.square(unseen.points - unseen.rest).sum()))


def _evaluation(first: Teacher) -> Callable[[Any], Any]:
    from facepipe.rig import build

    rig = build(first.parts)

    def evaluate(values: Any) -> Any:
        coefficients, weights = first(values)
        return rig.evaluate(weights, coefficients=coefficients) * (1000.0 * first.parts.meters_per_unit)

    return evaluate


def _carried(rig: NeuralRig, second: Teacher, name: str) -> list[Row]:
    """A person whose frames have known controls."""
    from facepipe.geometry.deformation_transfer import Transfer
    from facepipe.neural import SampleMotionOptions
    from facepipe.neural.options import RetargetOptions
    from facepipe.neural.retarget import RetargetNeuralRig, Subject, carried

    seen, unseen = (
        second.motion(SampleMotionOptions(spread=FRAMES, sweep=0, together=0, seed=seed)) for seed in (11, 12)
    )
    subject = Subject.of(second.parts, name)
    still = rig.points(rig.values({}))
    transfer = Transfer(subject.rest, subject.topology.triangles, np.zeros(len(subject.rest), bool))

    def moved(values: Any) -> Any:
        return transfer.solve(still[None], rig.points(values)[None])

    rows = [
        _row(name, "copied deltas", lambda one: subject.rest + rig.points(one) - still, unseen, None),
        _row(name, "deformation transfer", moved, unseen, None),
        _row(name, "carried, no frames", carried(rig, subject).points, unseen, None),
    ]
    for way, options in (
        (f"{FRAMES} frames, no noise", RetargetOptions(noise_mm=0.0)),
        (f"{FRAMES} frames", RetargetOptions()),
        (f"{FRAMES} frames, network, no noise", RetargetOptions(mode="network", noise=0.0)),
        (f"{FRAMES} frames, network", RetargetOptions(mode="network")),
    ):
        found = RetargetNeuralRig(options=options)(rig, subject, seen.points, seen.values).rig
        rows.append(_row(name, way, found.points, unseen, _size(found)))
    return rows


def _without_controls(rig: NeuralRig, second: Teacher, name: str) -> list[Row]:
    """The person's frames alone; unseen ones are made with the controls that each way comes nearest with."""
    from facepipe.neural import SampleMotionOptions
    from facepipe.neural.retarget import RetargetNeuralRig, Subject, compared

    seen, unseen = (
        second.motion(SampleMotionOptions(spread=FRAMES, sweep=0, together=0, seed=seed)) for seed in (11, 12)
    )
    subject = Subject.of(second.parts, name)
    found = RetargetNeuralRig()(rig, subject, seen.points).rig
    off = compared(found, rig, subject, unseen.points, None)
    return [
        Row(name, "copied deltas", off.copy_mean_mm),
        Row(name, "deformation transfer", off.transfer_mean_mm),
        Row(name, f"{FRAMES} frames without controls", off.error_mean_mm, off.error_max_mm, _size(found) / 1000.0),
    ]


def _row(of: str, way: str, points: Callable[[Any], Any], unseen: Motion, size: float | None) -> Row:
    start = time.process_time()
    off = [
        np.linalg.norm(points(values) - frame, axis=1)
        for values, frame in zip(unseen.values, unseen.points, strict=True)
    ]
    spent = time.process_time() - start
    kilobytes = None if size is None else size / 1000.0
    return Row(of, way, float(np.mean(off)), float(np.max(off)), kilobytes, 1000.0 * spent / len(off))


def _size(rig: NeuralRig) -> float:
    """Bytes of network and shapes."""
    return 4.0 * sum(one.size for one in (rig.shapes, rig.linear, rig.hidden, rig.hidden_bias, rig.last, rig.last_bias))


def _cells(row: Row) -> tuple[str, ...]:
    largest = "" if row.max_mm is None else f"{row.max_mm:.2f}"
    sizes = "" if row.kilobytes is None else f"{row.kilobytes:,.0f}"
    return row.of, row.way, f"{row.mean_mm:.4f}", largest, sizes, "" if row.ms is None else f"{row.ms:.1f}"


if __name__ == "__main__":
    raise SystemExit(main())
