"""Neural rigs: small networks that do what a face's rig does.

train samples the controls of a face (its sliders, and the shapes that none of them drives), evaluates them with the
face's rig, and learns from the frames. It needs the extra train (torch).

examples:
  facepipe neural-rig train head.usda -o head.fpnr
  facepipe neural-rig train head.usda -o head.fpnr --spread 2000 --width 256 --json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, table, warn
from facepipe.errors import InputError

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import Motion, NeuralRigReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments of each action."""
    from facepipe.processors.neural_rig import SampleMotionOptions, TrainNeuralRigOptions

    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    example = "example: facepipe neural-rig train head.usda -o head.fpnr"
    train = actions.add_parser("train", help="learn what the rig of a face does", epilog=example)
    train.add_argument("face", type=Path, metavar="FACE", help="face stage: .usda .usdc .usd .usdz")
    add_output(train, "neural rig to write: .fpnr")
    add_options(train, SampleMotionOptions, "frames")
    add_options(train, TrainNeuralRigOptions, "training")
    train.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Sample, train, write."""
    from facepipe.processors.neural_rig import TrainNeuralRig, TrainNeuralRigOptions, save_neural_rig
    from facepipe.processors.neural_rig.neural_rig_file import SUFFIX

    out = output_of(arguments, [arguments.face])
    if out.suffix != SUFFIX:
        raise InputError(out, f"suffix '{out.suffix}', expected {SUFFIX}")
    options = options_from(arguments, TrainNeuralRigOptions)
    motion = _motion(arguments)
    with progress("train", options.steps) as bar:
        trained = TrainNeuralRig(options=options)(motion, bar.update)
    report = json.loads(trained.report.to_json())
    save_neural_rig(trained.rig, out, report)
    warn(trained.report.warnings)
    emit({"path": str(out), **report}, _text(out, trained.report), as_json=arguments.json)
    return 0


def _motion(arguments: argparse.Namespace) -> Motion:
    import facepipe
    from facepipe.processors.neural_rig import SampleMotion, SampleMotionOptions
    from facepipe.processors.neural_rig.sample_motion import controls_of

    options = options_from(arguments, SampleMotionOptions)
    parts = facepipe.open(arguments.face).parts()
    with progress("frames", options.count(len(controls_of(parts)))) as bar:
        return SampleMotion(options=options)(parts, str(arguments.face), bar.update)


def _text(out: Path, report: NeuralRigReport) -> str:
    rows = [("mm, on frames held out", "mean", "largest")]
    rows += [("neural rig", f"{report.error_mean_mm:.4f}", f"{report.error_max_mm:.3f}")]
    rows += [("best blendshapes", f"{report.linear_mean_mm:.4f}", f"{report.linear_max_mm:.3f}")]
    learned = f"{out}: learned from {report.frames} frames, checked on {report.held_out}; {report.shapes} shapes"
    left = f"no frame moves {', '.join(report.left_out)}" if report.left_out else ""
    return "\n".join(line for line in (learned, table(rows), left) if line)
