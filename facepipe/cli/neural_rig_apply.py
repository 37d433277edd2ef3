"""`facepipe neural-rig apply`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, warn

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import ApplyNeuralRigReport


def add_apply(actions: argparse._SubParsersAction[Parser]) -> None:
    """The action and its arguments."""
    from facepipe.processors.neural_rig import AttachOptions

    example = "example: facepipe neural-rig apply head.usda head.fpnr -o neural.usda"
    parser = actions.add_parser("apply", help="put a neural rig on a face: its controls are sliders", epilog=example)
    parser.add_argument("face", type=Path, metavar="FACE", help="face stage of the meshes that it was learned on")
    parser.add_argument("rig", type=Path, metavar="RIG", help="neural rig: .fpnr")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    add_options(parser, AttachOptions, "shapes")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def apply(arguments: argparse.Namespace) -> int:
    """Open, author, save."""
    from facepipe.pipeline.neural_rig import make
    from facepipe.processors.neural_rig import AttachOptions
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.face, arguments.rig])
    check_suffix(out)
    options = options_from(arguments, AttachOptions)
    report = make(arguments.face, arguments.rig, options, out, flatten=arguments.flatten)
    warn(report.warnings)
    emit({"path": str(out), **json.loads(report.to_json())}, _text(out, report), as_json=arguments.json)
    return 0


def _text(out: Path, report: ApplyNeuralRigReport) -> str:
    what = f"{report.controls} sliders over {report.channels} channels and {report.shapes} shapes, {report.units} units"
    left = f"; {report.offsets:,} offsets, without those that are left out points are off by at most "
    clips = f", in clips by {report.clips_mm:.4f} mm" if report.clips_mm else ""
    return f"{out}: {what}{left}{report.dropped_mm:.4f} mm{clips}"
