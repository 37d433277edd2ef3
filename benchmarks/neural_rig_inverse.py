"""How near the inverse of a neural rig comes to controls that are known, and how fast, beside Adam.

Frames are those that the neural rig makes itself of controls drawn anew, and those that the rig it learned (the teacher
of neural_rig_teacher) makes of the same controls, which the neural rig can only come near. "Off" is the mean absolute
error of controls in shares of their ranges: of all, and of those whose standard error the report puts at 0.05 at most.
Adam is the published method, from random controls, with more and more steps; it has few of the frames, and so has the
row of Levenberg-Marquardt beside it.

    python benchmarks/neural_rig_inverse.py
    python benchmarks/neural_rig_inverse.py --rig head.fpnr --json inverse.json
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from arguments import add_common
from neural_rig_teacher import HEAD, Teacher, teacher
from tables import aligned

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import Motion
    from facepipe.rig.neural_rig import NeuralRig

FloatArray = npt.NDArray[np.floating]

SEED = 50  # of the frames; other numbers than those of training
FRAMES = 50  # that move up to 0.6 of the controls, and as many of two or three
FEW = 10  # of the first, for Adam
STEPS = {"with bones": (300, 1000, 3000), "without bones": (1000, 3000, 10000)}  # of Adam
TOLD = 0.05  # standard error of controls that targets tell


@dataclass(frozen=True)
class InverseRow:
    """One way to find controls."""

    of: str
    way: str
    frames: int
    mean_mm: float
    max_mm: float
    off: float  # of all controls
    told_off: float  # of those that targets tell
    told: int
    ms: float  # a frame


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 1, "one")
    parser.add_argument("--rig", type=Path, action="append", help="rig of the teacher; default: trained anew")
    arguments = parser.parse_args()
    if not (arguments.data / HEAD).exists():
        print(f"{arguments.data / HEAD}: not there, nothing to measure", file=sys.stderr)
        return 0
    first = teacher(arguments.data)
    unseen = frames_of(first)
    rows: list[InverseRow] = []
    for rig in _rigs(first, arguments.rig):
        rows += inverse_rows(rig, unseen)
    print("\n".join(inverse_table(rows)))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=2))
    return 0


def frames_of(first: Teacher) -> Motion:
    """Frames of the teacher that no training saw."""
    from facepipe.processors.neural_rig import SampleMotionOptions

    return first.motion(SampleMotionOptions(spread=FRAMES, busy=0.6, sweep=0, together=FRAMES, seed=SEED))


def inverse_rows(rig: NeuralRig, unseen: Motion) -> list[InverseRow]:
    """What each way makes of the rig's own frames, and of the teacher's."""
    name = "without bones" if rig.bones is None else "with bones"
    rows = []
    for source, points in (("own frames", rig.points(unseen.values)), ("teacher", np.asarray(unseen.points))):
        of = f"{name}, {source}"
        rows.append(_row(of, rig, unseen.values, points))
        few = slice(FEW)
        rows.append(_row(of, rig, unseen.values[few], points[few]))
        for steps in STEPS[name]:
            rows.append(_row(of, rig, unseen.values[few], points[few], mode="adam", adam_steps=steps))
    return rows


def inverse_table(rows: list[InverseRow]) -> list[str]:
    """Lines, with how many times as long as Levenberg-Marquardt on the same frames Adam takes."""
    head = ("rig and frames", "way", "frames", "mean mm", "max mm", "off", "told off", "told", "ms", "times")
    lines = [head]
    for row in rows:
        same = next(one for one in rows if (one.of, one.frames) == (row.of, row.frames))
        times = "" if same is row else f"{row.ms / same.ms:.1f}x"
        error = (f"{row.mean_mm:.4f}", f"{row.max_mm:.2f}", f"{row.off:.4f}", f"{row.told_off:.4f}")
        lines.append((row.of, row.way, str(row.frames), *error, str(row.told), f"{row.ms:.1f}", times))
    return aligned(lines)


def _row(of: str, rig: NeuralRig, values: FloatArray, points: FloatArray, **options: Any) -> InverseRow:
    from facepipe.processors.neural_rig import InvertNeuralRig, InvertNeuralRigOptions

    found = InvertNeuralRig(options=InvertNeuralRigOptions(**options))(rig, points)
    report = found.report
    ranges = np.array([control.maximum - control.minimum for control in rig.controls])
    off = np.abs(found.values - values).mean(axis=0) / ranges
    told = np.array([report.controls[control.name].std <= TOLD for control in rig.controls])
    return InverseRow(
        of=of,
        way="lm" if report.mode == "lm" else f"adam, {options['adam_steps']} steps",
        frames=len(points),
        mean_mm=report.error_mean_mm,
        max_mm=report.error_max_mm,
        off=float(off.mean()),
        told_off=float(off[told].mean()) if told.any() else float("nan"),
        told=int(told.sum()),
        ms=1000.0 * report.seconds_per_frame,
    )


def _rigs(first: Teacher, files: list[Path] | None) -> list[NeuralRig]:
    """Those of the files, or two that learn the teacher: with its bones, and without."""
    from facepipe.processors.neural_rig import SampleMotionOptions, TrainNeuralRig, load_neural_rig

    if files:
        return [load_neural_rig(file) for file in files]
    learned = first.motion(SampleMotionOptions(spread=3000, sweep=6, together=2000))
    return [TrainNeuralRig()(one).rig for one in (learned, replace(learned, bones=None, coefficients=None))]


if __name__ == "__main__":
    raise SystemExit(main())
