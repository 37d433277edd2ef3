"""Neural rigs: small networks that do what a face's rig does.

train samples the controls of a face (its sliders, and the shapes that none of them drives), evaluates them with the
face's rig, and learns from the frames; or it learns from a stage with what another program baked of its rig: controls
over time, and a point cache (docs/neural_rig.md). It needs the extra train (torch).

examples:
  facepipe neural-rig train head.usda -o head.fpnr
  facepipe neural-rig train head.usda -o head.fpnr --spread 2000 --width 256 --json
  facepipe neural-rig train range_of_motion.usdc --controls /Rig/Controls -o head.fpnr
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
    from facepipe.processors.neural_rig import FrameBlocksOptions, SampleMotionOptions, TrainNeuralRigOptions

    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    example = "example: facepipe neural-rig train head.usda -o head.fpnr"
    train = actions.add_parser("train", help="learn what the rig of a face does", epilog=example)
    data = "face stage, or one with controls and points over time: .usda .usdc .usd .usdz"
    train.add_argument("data", type=Path, metavar="DATA", help=data)
    add_output(train, "neural rig to write: .fpnr")
    kinds = "learn from the face's own rig, or from samples over time (default auto: samples where the stage has them)"
    train.add_argument("--source", choices=("auto", "rig", "samples"), default="auto", help=kinds)
    prims = "prim whose custom numbers are the controls, in place of facepipe:control:*; may be given again"
    train.add_argument("--controls", action="append", default=[], metavar="PRIM", help=prims)
    add_options(train, SampleMotionOptions, "frames of a face's own rig")
    add_options(train, FrameBlocksOptions, "frames over time")
    add_options(train, TrainNeuralRigOptions, "training")
    train.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Sample, train, write."""
    from facepipe.processors.neural_rig import TrainNeuralRig, TrainNeuralRigOptions, save_neural_rig
    from facepipe.processors.neural_rig.neural_rig_file import SUFFIX

    out = output_of(arguments, [arguments.data])
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
    from facepipe.processors.neural_rig import FrameBlocksOptions, ReadMotion, SampleMotion, SampleMotionOptions
    from facepipe.processors.neural_rig.sample_motion import controls_of
    from facepipe.stage.read_controls import is_recorded

    data, blocks = arguments.data, options_from(arguments, FrameBlocksOptions)
    if arguments.controls and arguments.source == "rig":
        raise InputError("--controls", "given with --source rig, expected samples over time")
    if arguments.source == "samples" or arguments.controls or (arguments.source == "auto" and is_recorded(data)):
        return ReadMotion(options=blocks, prims=arguments.controls)(data)
    options = options_from(arguments, SampleMotionOptions)
    parts = facepipe.open(data).parts()
    with progress("frames", options.count(len(controls_of(parts)))) as bar:
        return SampleMotion(options=options)(parts, str(data), bar.update)


def _text(out: Path, report: NeuralRigReport) -> str:
    rows = [("mm, on frames held out", "mean", "largest")]
    rows += [("neural rig", f"{report.error_mean_mm:.4f}", f"{report.error_max_mm:.3f}")]
    rows += [("best blendshapes", f"{report.linear_mean_mm:.4f}", f"{report.linear_max_mm:.3f}")]
    of = "over time" if report.source == "samples" else "of the face's own rig"
    learned = f"{out}: learned from {report.frames} frames {of}, checked on {report.held_out}; {report.shapes} shapes"
    left = f"no frame moves {', '.join(report.left_out)}" if report.left_out else ""
    return "\n".join(line for line in (learned, table(rows), left) if line)
