"""`facepipe neural-rig invert`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facepipe.processors.neural_rig import InverseReport

_SHOWN = 6  # controls


def add_invert(actions: argparse._SubParsersAction[Parser]) -> None:
    """The action and its arguments."""
    from facepipe.processors.neural_rig import InvertNeuralRigOptions

    example = "example: facepipe neural-rig invert head.fpnr talk.usdc -o controls.usda"
    text = "find controls for points: a pose, or a point cache over time"
    parser = actions.add_parser("invert", help=text, epilog=example)
    parser.add_argument("rig", type=Path, metavar="RIG", help="neural rig: .fpnr")
    target = "stage with the meshes that it was learned on, posed, animated or with points over time: .usda .usdc ..."
    parser.add_argument("target", type=Path, metavar="TARGET", help=target)
    add_output(parser, "stage of controls over time to write: .usda .usdc .usd .usdz")
    threshold = "exit 1 where the mean error of a frame is above this [mm]"
    parser.add_argument("--threshold-mm", type=float, metavar="MM", help=threshold)
    parser.add_argument("--no-encoder", action="store_true", help="don't start from the rig's encoder, if it has one")
    add_options(parser, InvertNeuralRigOptions, "how controls are found")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def invert(arguments: argparse.Namespace) -> int:
    """Read, find, write."""
    from facepipe.processors.neural_rig import InvertNeuralRig, InvertNeuralRigOptions, load_neural_rig
    from facepipe.processors.neural_rig.read_targets import read_targets
    from facepipe.stage.author_controls import save_controls
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.rig, arguments.target])
    check_suffix(out)
    threshold = arguments.threshold_mm
    if threshold is not None and not 0.0 <= threshold < float("inf"):
        raise InputError("--threshold-mm", f"{threshold:g}, expected 0 or more")
    rig = load_neural_rig(arguments.rig)
    targets = read_targets(arguments.target, rig)
    found = InvertNeuralRig(options=options_from(arguments, InvertNeuralRigOptions))
    start = None if arguments.no_encoder or found.options.mode == "adam" else _start(arguments.rig, targets.points)
    with progress("invert", found.calls(len(targets.points))) as bar:
        inverted = found(rig, targets.points, start=start, blocks=targets.blocks, done=bar.update)
    save_controls(out, rig.controls, inverted.values, targets.codes, targets.codes_per_second)
    report = inverted.report
    missed = threshold is not None and report.worst_frame_mm > threshold
    if missed:
        warn([f"frame {report.worst_frame} is {report.worst_frame_mm:.4f} mm off, more than {threshold:g} mm"])
    emit({"path": str(out), **json.loads(report.to_json())}, _text(out, report), as_json=arguments.json)
    return 1 if missed else 0


def _start(rig: Path, points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating] | None:
    """What the encoder in the file says, if it holds one."""
    from facepipe.processors.neural_rig.neural_rig_file import has_encoder, load_encoder

    return load_encoder(rig).values(points) if has_encoder(rig) else None


def _text(out: Path, report: InverseReport) -> str:
    errors = (report.error_mean_mm, report.error_rms_mm, report.error_p95_mm, report.error_max_mm)
    rows = [("mm, over all points", "mean", "RMS", "95%", "largest"), ("", *(f"{error:.4f}" for error in errors))]
    frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
    spent = f"{frames}, {report.steps:.1f} steps and {1000.0 * report.seconds_per_frame:.1f} ms each"
    lines = [f"{out}: controls of {spent}", table(rows)]
    lost = report.not_identifiable
    if lost:
        more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
        lines.append(f"targets don't tell {', '.join(lost[:_SHOWN])}{more}")
    return "\n".join(lines)
