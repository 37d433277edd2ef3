"""Bake what a face's rig does: controls over time, and a point cache of where they move the points.

OUT holds the meshes with points over time (millimetres, Y up), and the controls as numbers facepipe:control:NAME over
time, with their ranges and defaults: the sliders of the face that have a range, and the shapes that no slider drives or
that clips move. Frames are each control alone from one limit to the other (--sweep), many at once (--spread), two or
three together (--together), and clips: those of the face that move its controls, and --clip. What no control does, such
as joints of a clip, is left out with a warning. `facepipe neural-rig train` and `retarget --frames` read OUT, and so
does any program that plays USD point caches.

examples:
  facepipe bake head.usda -o head_motion.usdc
  facepipe bake anna.usda -o anna_frames.usdc --sweep 0 --spread 100 --together 0
  facepipe neural-rig retarget head.fpnr anna.usda --frames anna_frames.usdc -o anna.fpnr
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn

if TYPE_CHECKING:
    from facepipe.processors.neural_rig import BakeReport


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.neural_rig import SampleMotionOptions

    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    add_output(parser, "stage of controls and points over time to write: .usdc .usda .usd .usdz")
    clip = "stage whose clips the face plays too, beside those of its own; may be given again"
    parser.add_argument("--clip", type=Path, action="append", default=[], metavar="STAGE", help=clip)
    add_options(parser, SampleMotionOptions, "frames")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Open, evaluate, write."""
    import facepipe
    from facepipe.processors.neural_rig import BakeMotion, SampleMotionOptions
    from facepipe.stage.files import check_suffix

    out = output_of(arguments, [arguments.face, *arguments.clip])
    check_suffix(out)
    baked = BakeMotion(options=options_from(arguments, SampleMotionOptions), clips=arguments.clip)
    face = facepipe.read(arguments.face)
    drawn = baked.options.count(len(baked.controls(face.parts(), arguments.face)))
    with progress("bake", drawn) as bar:
        report = baked(face, arguments.face, out, bar.update)
    warn(report.warnings)
    path = {"path": str(out), "bytes": out.stat().st_size}
    emit({**path, **json.loads(report.to_json())}, _text(out, report), as_json=arguments.json)
    return 0


def _text(out: Path, report: BakeReport) -> str:
    clips = f", {report.clip_frames} of them of clips" if report.clip_frames else ""
    what = f"{report.frames} frames{clips}, of {report.controls} controls and {report.points:,} points"
    still = f"\nno frame moves {', '.join(report.still)}" if report.still else ""
    return f"{out}: {out.stat().st_size:,} bytes: {what}, moved by {report.motion_mean_mm:.2f} mm on average{still}"
