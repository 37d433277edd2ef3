"""Neural rigs: small networks that do what a face's rig does.

train samples the controls of a face (its sliders, and the shapes that none of them drives), evaluates them with the
face's rig, and learns from the frames; or it learns from a stage with what another program baked of its rig: controls
over time, and a point cache (docs/neural_rig.md). It needs the extra train (torch).

apply puts a neural rig on a face of the meshes that it was learned on, its controls as sliders beside all that the face
has: an override layer that links the rig. `facepipe export --neural` writes what an engine loads.

invert finds the controls of points, of a pose, of a point cache over time or of a face that a SkelAnimation moves, on
the meshes that the rig was learned on.

retarget carries a rig to another person, of some frames of that person: the same controls drive both.

examples:
  facepipe neural-rig train head.usda -o head.fpnr
  facepipe neural-rig train head.usda -o head.fpnr --spread 2000 --width 256 --json
  facepipe neural-rig train head.usda --clip head.usda --clip talk.usdc -o head.fpnr
  facepipe neural-rig train range_of_motion.usdc --controls /Rig/Controls -o head.fpnr
  facepipe neural-rig apply head.usda head.fpnr -o neural.usda
  facepipe neural-rig retarget head.fpnr anna.usda --frames anna_clip.usdc -o anna.fpnr
  facepipe neural-rig invert head.fpnr talk.usdc -o controls.usda --threshold-mm 0.5
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli import action_line
from facepipe.cli.neural_rig_invert import add_invert, invert
from facepipe.cli.neural_rig_retarget import add_retarget, retarget
from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.texts import table
from facepipe.processors.neural_rig import apply_action
from facepipe.processors.neural_rig.apply_action import ApplyNeuralRig

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import EncoderReport, Motion, NeuralRigReport, TrainedEncoder, TrainedNeuralRig


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments of each action."""
    from facepipe.processors.neural_rig import (
        FrameBlocksOptions,
        SampleMotionOptions,
        TrainEncoderOptions,
        TrainNeuralRigOptions,
    )

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
    clip = "stage whose clips the face's own rig plays too, its own stage among them; may be given again"
    train.add_argument("--clip", type=Path, action="append", default=[], metavar="STAGE", help=clip)
    add_options(train, SampleMotionOptions, "frames of a face's own rig")
    add_options(train, FrameBlocksOptions, "frames over time")
    add_options(train, TrainNeuralRigOptions, "training")
    add_options(train, TrainEncoderOptions, "encoder")
    train.add_argument("--no-encoder", action="store_true", help="train no encoder, from points back to controls")
    file = "file that keeps where the training stands: killed, the same command goes on from there"
    train.add_argument("--checkpoint", type=Path, metavar="FILE", help=file)
    train.add_argument("--plot", type=Path, metavar="PNG", help="picture of what is left of the motion, step by step")
    train.add_argument("--json", action="store_true", help="print the report as JSON")
    put = actions.add_parser("apply", help=ApplyNeuralRig.summary, description=apply_action.__doc__)
    action_line.configure(put, ApplyNeuralRig)
    add_invert(actions)
    add_retarget(actions)


def run(arguments: argparse.Namespace) -> int:
    """The action."""
    if arguments.action == "apply":
        return action_line.run(arguments, ApplyNeuralRig)
    return {"train": _train, "invert": invert, "retarget": retarget}[arguments.action](arguments)


def _train(arguments: argparse.Namespace) -> int:
    from facepipe.core.atomic import together
    from facepipe.processors.neural_rig import TrainNeuralRig, TrainNeuralRigOptions, save_neural_rig
    from facepipe.processors.neural_rig.neural_rig_file import SUFFIX

    out = output_of(arguments, [arguments.data, *arguments.clip])
    if out.suffix != SUFFIX:
        raise InputError(out, f"suffix '{out.suffix}', expected {SUFFIX}")
    _check_files(arguments, out)
    options = options_from(arguments, TrainNeuralRigOptions)
    motion = _motion(arguments)
    with progress("train", options.steps) as bar:
        trained = TrainNeuralRig(options=options)(motion, bar.update, arguments.checkpoint)
    warn(trained.report.warnings)  # before the encoder, which takes its time too
    encoded = _encoder(arguments, motion)
    report = json.loads(trained.report.to_json())
    report["encoder"] = json.loads(encoded.report.to_json()) if encoded else None
    with together(out):
        save_neural_rig(trained.rig, out, report, encoded.encoder if encoded else None)
        _draw(arguments.plot, trained)
    if arguments.checkpoint is not None:
        arguments.checkpoint.unlink(missing_ok=True)
    text = [_text(out, trained.report), *([_encoder_text(encoded.report)] if encoded else [])]
    emit({"path": str(out), **report}, "\n".join(text), as_json=arguments.json)
    return 0


def _check_files(arguments: argparse.Namespace, out: Path) -> None:
    """:raises InputError: two files of one name, or a picture that is there already"""
    others = [one for one in (arguments.plot, arguments.checkpoint) if one is not None]
    if len({one.resolve() for one in (out, *others)}) != 1 + len(others):
        raise InputError(out, "two outputs of one name, expected a file each")
    if arguments.plot is not None and arguments.plot.exists() and not arguments.force:
        raise InputError(arguments.plot, "exists, expected a new file (or --force)")


def _draw(path: Path | None, trained: TrainedNeuralRig) -> None:
    if path is None or trained.report.straight:
        return
    from facepipe.pictures.training_curve import draw_training_curve

    draw_training_curve(trained.curve, path)


def _encoder(arguments: argparse.Namespace, motion: Motion) -> TrainedEncoder | None:
    from facepipe.processors.neural_rig import TrainEncoder, TrainEncoderOptions

    if arguments.no_encoder:
        return None
    options = options_from(arguments, TrainEncoderOptions)
    with progress("encoder", options.encoder_steps) as bar:
        return TrainEncoder(options=options)(motion, bar.update, arguments.checkpoint)


def _motion(arguments: argparse.Namespace) -> Motion:
    from facepipe.processors.neural_rig import FrameBlocksOptions, ReadMotion

    if _over_time(arguments):
        return ReadMotion(options=options_from(arguments, FrameBlocksOptions), prims=arguments.controls)(arguments.data)
    return _sampled(arguments)


def _over_time(arguments: argparse.Namespace) -> bool:
    """Whether to learn from samples on the stage.

    :raises InputError: flags that don't go together
    """
    from facepipe.stage.read_controls import is_recorded

    for flag, given, other, expected in (
        ("--controls", arguments.controls, "rig", "samples over time"),
        ("--clip", arguments.clip, "samples", "a face's own rig to play it"),
    ):
        if given and arguments.source == other:
            raise InputError(flag, f"given with --source {other}, expected {expected}")
    if arguments.controls and arguments.clip:
        raise InputError("--clip", "given with --controls, expected one of them")
    if arguments.source != "auto" or arguments.clip:
        return bool(arguments.source == "samples")
    return bool(arguments.controls) or is_recorded(arguments.data)


def _sampled(arguments: argparse.Namespace) -> Motion:
    import facepipe
    from facepipe.processors.neural_rig import FrameBlocksOptions, ReadClips, SampleMotion, SampleMotionOptions
    from facepipe.processors.neural_rig.sample_motion import controls_of

    options, parts = options_from(arguments, SampleMotionOptions), facepipe.open(arguments.data).parts()
    controls, clips = controls_of(parts), None
    if arguments.clip:
        clips = ReadClips(options=options_from(arguments, FrameBlocksOptions))(arguments.clip, controls)
    with progress("frames", options.count(len(controls)) + (len(clips.values) if clips else 0)) as bar:
        return SampleMotion(options=options)(parts, str(arguments.data), bar.update, clips)


def _text(out: Path, report: NeuralRigReport) -> str:
    rows = [("mm, on frames held out", "mean", "largest")]
    rows += [("neural rig", f"{report.error_mean_mm:.4f}", f"{report.error_max_mm:.3f}")]
    rows += [("ridge regression", f"{report.ridge_mean_mm:.4f}", f"{report.ridge_max_mm:.3f}")]
    rows += [("best blendshapes", f"{report.linear_mean_mm:.4f}", f"{report.linear_max_mm:.3f}")]
    own = "of the face's own rig"
    of = {"samples": "over time", "rig and clips": f"{own} and of clips"}.get(report.source, own)
    between = f", {report.between} between blocks left out" if report.between else ""
    learned = f"{out}: learned from {report.frames} frames {of}, checked on {report.held_out}{between}"
    learned += f"; {report.shapes} shapes"
    left = f"no frame moves {', '.join(report.left_out)}" if report.left_out else ""
    return "\n".join(line for line in (learned, table(rows), left) if line)


def _encoder_text(report: EncoderReport) -> str:
    rows = [("controls off, % of their range", "mean", "median control")]
    for name, mean, median in (
        ("encoder", report.error_mean, report.error_median),
        ("ridge regression", report.ridge_mean, report.ridge_median),
    ):
        rows.append((name, f"{100 * mean:.2f}", f"{100 * median:.2f}"))
    return table(rows)
