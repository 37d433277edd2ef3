"""`facepipe neural-rig retarget`."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import Parser, add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.neural_rig.retarget_report import RetargetReport


def add_retarget(actions: argparse._SubParsersAction[Parser]) -> None:
    """The action and its arguments."""
    from facepipe.processors.neural_rig.options import RetargetOptions

    example = "example: facepipe neural-rig retarget head.fpnr anna.usda --frames anna_clip.usdc -o anna.fpnr"
    text = "carry a neural rig to another person, of some frames of that person"
    parser = actions.add_parser("retarget", help=text, epilog=example)
    parser.add_argument("rig", type=Path, metavar="RIG", help="neural rig: .fpnr")
    face = "face stage of the person, on the same topology, with the same joints if the rig has some"
    parser.add_argument("face", type=Path, metavar="FACE", help=face)
    frames = "stage with the person's points over time; with controls over time too where these are known"
    parser.add_argument("--frames", type=Path, required=True, metavar="STAGE", help=frames)
    add_output(parser, "neural rig of the person to write: .fpnr")
    add_options(parser, RetargetOptions, "how the person's own motion is learned")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def retarget(arguments: argparse.Namespace) -> int:
    """Read, learn, write."""
    import facepipe
    from facepipe.processors.neural_rig import load_neural_rig, save_neural_rig
    from facepipe.processors.neural_rig.carried_rig import Subject
    from facepipe.processors.neural_rig.neural_rig_file import SUFFIX
    from facepipe.processors.neural_rig.options import RetargetOptions
    from facepipe.processors.neural_rig.retarget import RetargetNeuralRig
    from facepipe.processors.neural_rig.subject_frames import read_subject_frames

    out = output_of(arguments, [arguments.rig, arguments.face, arguments.frames])
    if out.suffix != SUFFIX:
        raise InputError(out, f"suffix '{out.suffix}', expected {SUFFIX}")
    rig = load_neural_rig(arguments.rig)
    subject = Subject.of(facepipe.open(arguments.face).parts(), str(arguments.face)).checked(rig)
    frames = read_subject_frames(arguments.frames, rig)
    processor = RetargetNeuralRig(options=options_from(arguments, RetargetOptions))
    with progress("retarget", processor.calls) as bar:
        found = processor(rig, subject, frames.points, frames.values, bar.update)
    told = replace(found.report, between=frames.between)
    report = json.loads(told.to_json())
    save_neural_rig(found.rig, out, report)
    warn(told.warnings)
    emit({"path": str(out), **report}, _text(out, told), as_json=arguments.json)
    return 0


def _text(out: Path, report: RetargetReport) -> str:
    rows = [("mm, on frames held out", "mean")]
    rows += [("retargeted rig", f"{report.error_mean_mm:.4f}")]
    rows += [("deformation transfer", f"{report.transfer_mean_mm:.4f}")]
    rows += [("copied deltas", f"{report.copy_mean_mm:.4f}")]
    between = f", {report.between} between blocks left out" if report.between else ""
    learned = f"{out}: learned from {report.frames} frames, checked on {report.held_out}{between}"
    return f"{learned}; controls {report.controls}; {report.shapes} shapes\n{table(rows)}"
