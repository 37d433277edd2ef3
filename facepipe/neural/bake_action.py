"""Bake what a face's rig does: controls over time, and a point cache of where they move the points.

OUT holds the meshes with points over time (millimetres, Y up), and the controls as numbers facepipe:control:NAME over
time, with their ranges and defaults: the sliders of the face that have a range, and the shapes that no slider drives or
that clips move. Frames are each control alone from one limit to the other (--sweep), many at once (--spread), two or
three together (--together), and clips: those of the face that move its controls, and --clip. What no control does, such
as joints of a clip, is left out with a warning. `facepipe neural-rig train` and `retarget --frames` read OUT, and so
does any program that plays USD point caches.

examples:
  facepipe bake head.usdc -o head_motion.usdc
  facepipe bake anna.usdc -o anna_frames.usdc --sweep 0 --spread 100 --together 0
  facepipe neural-rig retarget head.fpnr anna.usdc --frames anna_frames.usdc -o anna.fpnr
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import source
from facepipe.kinds import FileAction, Job, action
from facepipe.neural.options import SampleMotionOptions

if TYPE_CHECKING:
    from facepipe.neural.motion import BakeReport


@action("bake", "write what a face's rig does as controls and points over time")
@dataclass(frozen=True, kw_only=True)
class Bake(SampleMotionOptions, FileAction["BakeReport"]):
    """The action."""

    output = "stage of controls and points over time to write: .usdc .usda .usd .usdz"
    suffixes = (".usdc", ".usda", ".usd", ".usdz")

    face: Path = source("face stage")
    clips: tuple[Path, ...] = source(
        "stage whose clips the face plays too, beside those of its own", default=(), flag="--clip", metavar="STAGE"
    )

    def write(self, job: Job) -> BakeReport:
        from facepipe.importers import read_face
        from facepipe.neural.motion import BakeMotion

        baked = BakeMotion(options=self, clips=self.clips)
        face = read_face(self.face)
        with job.watch("bake", self.count(len(baked.controls(face.parts(), self.face)))) as bar:
            return baked(face, self.face, job.out, bar.update)

    def text(self, report: BakeReport, out: Path) -> str:
        clips = f", {report.clip_frames} of them of clips" if report.clip_frames else ""
        what = f"{report.frames} frames{clips}, of {report.controls} controls and {report.points:,} points"
        still = f"\nno frame moves {', '.join(report.still)}" if report.still else ""
        return f"{out}: {out.stat().st_size:,} bytes: {what}, moved by {report.motion_mean_mm:.2f} mm on average{still}"
