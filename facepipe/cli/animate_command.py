"""Put a captured performance on a face: a clip that its skeleton plays, on an override layer.

CLIP is a CSV of Live Link Face (Timecode, BlendShapeCount, 52 shapes, turns of head and eyes), a CSV of shape names
(with a column Timecode, Time in seconds, or Frame, or a row a frame), or ARKit weights in JSON. Names are matched in
any case and with sides in any usual form; what has no target is listed. Frames that CLIP lacks are filled. A timecode
counts frames: --fps says how many make a second. Turns are radians unless --angles deg; joints are found by name.

examples:
  facepipe animate head.usda take.csv -o take.usda
  facepipe animate head.usda take.csv -o take.usda --fps 30 --start 2.5 --end 10
  facepipe animate ict.usdc take.json -o take.usda --resample 24 --name hello
  facepipe export take.usda -o take.glb --animations
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn

if TYPE_CHECKING:
    from facepipe.processors.animate import AnimateReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.animate.options import AnimateOptions

    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    parser.add_argument("clip", type=Path, metavar="CLIP", help="performance: .csv .json")
    add_output(parser, "override layer to write: .usda .usdc .usd .usdz")
    parser.add_argument("--name", help="name of the animation (default: the file's)")
    add_options(parser, AnimateOptions)
    parser.add_argument("--flatten", action="store_true", help="write a standalone file")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read, animate, report."""
    from facepipe.pipeline.animate import AnimateJob, make
    from facepipe.processors.animate import AnimateOptions
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.face, arguments.clip])
    check_suffix(out)
    job = AnimateJob(
        face=arguments.face,
        clip=arguments.clip,
        out=out,
        name=arguments.name,
        options=options_from(arguments, AnimateOptions),
        flatten=arguments.flatten,
    )
    report = make(job, progress)
    warn(report.warnings)
    emit({"path": str(out), **dataclasses.asdict(report)}, f"{out}: {as_text(report)}", as_json=arguments.json)
    return 0


def as_text(report: AnimateReport) -> str:
    """The report for people."""
    span = f"{report.start:g} to {report.end:g} s at {report.frames_per_second:g} fps"
    joints = "".join(f", {part} by {path.rpartition('/')[2]}" for part, path in report.joints.items())
    sliders = f", {len(report.sliders)} sliders" if report.sliders else ""
    filled = f", {report.filled:,} of them filled" if report.filled else ""
    lines = [
        f"{report.animation}: {report.frames:,} frames{filled}, {span}: {len(report.shapes)} shapes{sliders}{joints}"
    ]
    reasons = dict.fromkeys(report.no_target.values())
    for reason in reasons:
        names = ", ".join(name for name, why in report.no_target.items() if why == reason)
        lines.append(f"no target: {names} ({reason})")
    return "\n".join(lines)
