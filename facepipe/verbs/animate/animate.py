"""Put a captured performance on a face: a clip that its skeleton plays, on an override layer.

CLIP is a recording of Live Link Face, of MediaPipe's face landmarker, of Audio2Face or Azure, keys of TalkingHead, any
CSV of shape names (with a column Timecode, Time or Frame, or a row a frame), ARKit weights in JSON, or a USD or glTF
file with a clip, alone or on another face. What it is and its units are found out by what it holds, and said. Names are
matched in any case and with sides in any usual form; what has no target is listed. What CLIP lacks is filled.

examples:
  facepipe animate head.usdc take.csv -o take.usda
  facepipe animate head.usdc take.csv -o take.usda --fps 30 --start 2.5 --end 10
  facepipe animate ict.usdc take.json -o take.usda --resample 24 --name hello
  facepipe export take.usda -o take.glb --animations
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.names import check_identifier, identifier
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.animate.options import AnimateOptions

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.animate.face_clip import AnimateReport


@action("animate", "put a captured performance on a face", remote=True)
@dataclass(frozen=True, kw_only=True)
class Animate(AnimateOptions, StageAction["AnimateReport"]):
    """The action."""

    face: Path = source("face stage")
    clip: Path = source("performance: .csv .tsv .txt .json .jsonl .usd .usda .usdc .usdz .glb .gltf .vrm .fbx")
    name: str | None = option(None, "name of the animation (default: the file's)")

    def check(self) -> None:
        super().check()
        if self.name is not None:
            check_identifier("--name", self.name)

    def author(self, face: Face, job: Job) -> AnimateReport:
        from facepipe.verbs.animate.clip_files import read_performance
        from facepipe.verbs.animate.face_clip import AnimateFace

        recipe, name = job.recipe(), self.name or identifier(self.clip.stem)
        performance = read_performance(self.clip, self.fps, angles=self.angles)
        with job.watch("animate", len(performance.values)) as bar:
            animate = AnimateFace(performance=performance, name=name, options=self)
            return animate(face, recipe=recipe, done=bar.update)

    def text(self, report: AnimateReport, out: Path) -> str:
        span = f"{report.start:g} to {report.end:g} s at {report.frames_per_second:g} fps"
        joints = "".join(f", {part} by {path.rpartition('/')[2]}" for part, path in report.joints.items())
        sliders = f", {len(report.sliders)} sliders" if report.sliders else ""
        filled = f", {report.filled:,} of them filled" if report.filled else ""
        clip = f"{report.animation}: {report.frames:,} frames{filled}, {span}"
        lines = [f"read as {report.read_as}", f"{out}: {clip}: {len(report.shapes)} shapes{sliders}{joints}"]
        for reason in dict.fromkeys(report.no_target.values()):
            names = ", ".join(name for name, why in report.no_target.items() if why == reason)
            lines.append(f"no target: {names} ({reason})")
        return "\n".join(lines)
