"""Carry a neural rig to another person, of some frames of that person: the same controls drive both.

example: facepipe neural-rig retarget head.fpnr anna.usdc --frames anna_clip.usdc -o anna.fpnr
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import table
from facepipe.declare import source
from facepipe.kinds import FileAction, Job, action
from facepipe.neural.options import RetargetOptions

if TYPE_CHECKING:
    from facepipe.neural.retarget import RetargetReport


@action("neural-rig retarget", "carry a neural rig to another person, of some frames of that person")
@dataclass(frozen=True, kw_only=True)
class Retarget(RetargetOptions, FileAction["RetargetReport"]):
    """The action."""

    output = "neural rig of the person to write: .fpnr"
    suffixes = (".fpnr",)

    rig: Path = source("neural rig: .fpnr")
    face: Path = source("face stage of the person, on the same topology, with the same joints if the rig has some")
    frames: Path = source(
        "stage with the person's points over time; with controls over time too where these are known",
        flag="--frames",
        metavar="STAGE",
    )

    def write(self, job: Job) -> RetargetReport:
        from facepipe.neural.neural_rig_file import load_neural_rig, save_neural_rig
        from facepipe.neural.read_motion import read_subject_frames
        from facepipe.neural.retarget import RetargetNeuralRig, Subject
        from facepipe.stage import open_face

        rig = load_neural_rig(self.rig)
        subject = Subject.of(open_face(self.face).parts(), str(self.face)).checked(rig)
        frames = read_subject_frames(self.frames, rig)
        processor = RetargetNeuralRig(options=self)
        with job.watch("retarget", processor.calls) as bar:
            found = processor(rig, subject, frames.points, frames.values, bar.update)
        report = replace(found.report, between=frames.between)
        save_neural_rig(found.rig, job.out, report.to_dict())
        return report

    def text(self, report: RetargetReport, out: Path) -> str:
        rows = [("mm, on frames held out", "mean")]
        rows += [("retargeted rig", f"{report.error_mean_mm:.4f}")]
        rows += [("deformation transfer", f"{report.transfer_mean_mm:.4f}")]
        rows += [("copied deltas", f"{report.copy_mean_mm:.4f}")]
        between = f", {report.between} between blocks left out" if report.between else ""
        learned = f"{out}: learned from {report.frames} frames, checked on {report.held_out}{between}"
        return f"{learned}; controls {report.controls}; {report.shapes} shapes\n{table(rows)}"
