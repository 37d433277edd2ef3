"""How near the inverse of a neural rig comes to controls that are known, and how fast, beside Adam.

Frames are those that the neural rig makes itself of controls drawn anew, and those that the rig it learned (the teacher
of neural_rig_teacher) makes of the same controls, which the neural rig can only come near. "Off" is the mean absolute
error of controls in shares of their ranges: of all, and of those whose standard error the report puts at 0.05 at most.
Adam is the published method, from random controls, with more and more steps, and the same from the defaults, where
Levenberg-Marquardt starts; it has few of the frames. "Times" is how many times as long as Levenberg-Marquardt on the
same frames it takes to the same error, within a hundredth: this one is stopped after one step, two, three and so on,
and the shortest run that comes to what Adam ends with is taken. Where a rig has an encoder Levenberg-Marquardt starts
from it too.

    python benchmarks/neural_rig_inverse.py
    python benchmarks/neural_rig_inverse.py --rig head.fpnr --json inverse.json
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import add_common
from neural_rig_teacher import HEAD, Teacher, teacher
from tables import aligned

if TYPE_CHECKING:
    from facepipe.neural import Motion
    from facepipe.rig.neural_rig import NeuralEncoder, NeuralRig

FloatArray = npt.NDArray[np.floating]

SEED = 50  # of the frames; other numbers than those of training
FRAMES = 50  # that move up to 0.6 of the controls, and as many of two or three
FEW = 10  # of the first, for Adam
STEPS = {"with bones": (300, 1000, 3000), "without bones": (1000, 3000, 10000)}  # of Adam
STOPS = 40  # steps of Levenberg-Marquardt that it is stopped before
NEAR = 1.01  # times an error that are the same
KNOWN = 0.05  # standard error of controls that targets determine


@dataclass(frozen=True)
class InverseRow:
    """One way to find controls."""

    of: str
    way: str
    frames: int
    mean_mm: float
    max_mm: float
    off: float  # of all controls
    known_off: float  # of those that targets determine
    known: int
    steps: float
    ms: float  # a frame, of one processor, the report among it
    lm_ms: float | None = None  # a frame, of Levenberg-Marquardt to the same error


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 1, "one")
    parser.add_argument("--rig", type=Path, action="append", help="rig of the teacher; default: trained anew")
    arguments = parser.parse_args()
    if not (arguments.data / HEAD).exists():
        print(f"{arguments.data / HEAD}: not there, nothing to measure", file=sys.stderr)
        return 0
    importlib.import_module("facepipe.neural.learning.neural_inverse")  # torch takes longer than many a row
    first = teacher(arguments.data)
    unseen = frames_of(first)
    rows: list[InverseRow] = []
    for rig, encoder in _rigs(first, arguments.rig):
        rows += inverse_rows(rig, unseen, encoder)
    print("\n".join(inverse_table(rows)))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=2))
    return 0


def frames_of(first: Teacher) -> Motion:
    """Frames of the teacher that no training saw."""
    from facepipe.neural import SampleMotionOptions

    return first.motion(SampleMotionOptions(spread=FRAMES, busy=0.6, sweep=0, together=FRAMES, seed=SEED))


def inverse_rows(rig: NeuralRig, unseen: Motion, encoder: NeuralEncoder | None = None) -> list[InverseRow]:
    """What each way makes of the rig's own frames, and of the teacher's."""
    name = "without bones" if rig.bones is None else "with bones"
    rows = []
    for source, points in (("own frames", rig.points(unseen.values)), ("teacher", np.asarray(unseen.points))):
        of, values = f"{name}, {source}", unseen.values
        rows.append(_row(of, "lm", rig, values, points))
        if encoder is not None:
            rows.append(_row(of, "lm from the encoder", rig, values, points, encoder.values(points)))
        values, points = values[:FEW], points[:FEW]
        rows += _adam_rows(of, rig, values, points, STEPS[name])
    return rows


def _adam_rows(
    of: str, rig: NeuralRig, values: FloatArray, points: FloatArray, counts: tuple[int, ...]
) -> list[InverseRow]:
    """Adam beside Levenberg-Marquardt that is stopped earlier and earlier."""
    whole = _row(of, "lm", rig, values, points)
    ladder, rows = [whole], [whole]
    for steps in range(1, STOPS):
        ladder.append(_row(of, "lm", rig, values, points, starts=1, steps=steps))
        if ladder[-1].steps < 0.9 * steps or ladder[-1].mean_mm <= whole.mean_mm:
            break
    still = np.tile(rig.values({}), (len(points), 1))
    for way, start in (("adam", None), ("adam from defaults", still)):
        for steps in counts:
            row = _row(of, f"{way}, {steps} steps", rig, values, points, start, mode="adam", adam_steps=steps)
            as_near = [one.ms for one in ladder if one.mean_mm <= NEAR * row.mean_mm]
            rows.append(replace(row, lm_ms=min(as_near, default=None)))
    return rows


def inverse_table(rows: list[InverseRow]) -> list[str]:
    """Lines, with how many times as long as Levenberg-Marquardt Adam takes to the same error."""
    head = ("rig and frames", "way", "frames", "mean mm", "max mm", "off", "known off", "known", "steps", "ms", "times")
    lines = [head]
    for row in rows:
        times = f"{row.ms / row.lm_ms:.1f}x" if row.lm_ms else "nearer" if row.way.startswith("adam") else ""
        error = (f"{row.mean_mm:.4f}", f"{row.max_mm:.2f}", f"{row.off:.4f}", f"{row.known_off:.4f}")
        spent = (f"{row.steps:.1f}", f"{row.ms:.1f}", times)
        lines.append((row.of, row.way, str(row.frames), *error, str(row.known), *spent))
    return aligned(lines)


def _row(
    of: str,
    way: str,
    rig: NeuralRig,
    values: FloatArray,
    points: FloatArray,
    start: FloatArray | None = None,
    **options: Any,
) -> InverseRow:
    from facepipe.neural import InvertNeuralRig, InvertNeuralRigOptions

    begun = time.process_time()
    found = InvertNeuralRig(options=InvertNeuralRigOptions(**options))(rig, points, start)
    spent, report = time.process_time() - begun, found.report
    ranges = np.array([control.maximum - control.minimum for control in rig.controls])
    off = np.abs(found.values - values).mean(axis=0) / ranges
    known = np.array([report.controls[control.name].std <= KNOWN for control in rig.controls])
    return InverseRow(
        of=of,
        way=way,
        frames=len(points),
        mean_mm=report.error_mean_mm,
        max_mm=report.error_max_mm,
        off=float(off.mean()),
        known_off=float(off[known].mean()) if known.any() else float("nan"),
        known=int(known.sum()),
        steps=report.steps,
        ms=1000.0 * spent / len(points),
    )


def _rigs(first: Teacher, files: list[Path] | None) -> list[tuple[NeuralRig, NeuralEncoder | None]]:
    """Those of the files, or two that learn the teacher: with its bones, and without; and their encoders."""
    from facepipe.neural import SampleMotionOptions, TrainEncoder, TrainNeuralRig, TrainNeuralRigOptions
    from facepipe.neural.neural_rig_file import has_encoder, load_encoder, load_neural_rig

    if files:
        return [(load_neural_rig(one), load_encoder(one) if has_encoder(one) else None) for one in files]
    learned = first.motion(SampleMotionOptions(spread=3000, sweep=6, together=2000))
    encoder = TrainEncoder()(learned).encoder
    motions = (learned, replace(learned, bones=None, coefficients=None))
    train = TrainNeuralRig(options=TrainNeuralRigOptions(influences=0))
    return [(train(motion).rig, encoder) for motion in motions]


if __name__ == "__main__":
    raise SystemExit(main())
