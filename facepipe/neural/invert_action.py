"""Find the controls of points, on the meshes that a neural rig was learned on; OUT holds controls over time.

TARGET is posed, a point cache over time, or a face that a SkelAnimation moves. The encoder of RIG, if it has one, says
where to start. Exit code 1: OUT is written, but a frame misses --threshold-mm.

example: facepipe neural-rig invert head.fpnr talk.usdc -o controls.usda --threshold-mm 0.5
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import table
from facepipe.declare import option, source
from facepipe.kinds import FileAction, Job, action
from facepipe.neural.options import InvertNeuralRigOptions

if TYPE_CHECKING:
    from facepipe.neural.invert import InverseReport

_SHOWN = 6  # controls


@action("neural-rig invert", "find controls for points: a pose, or a point cache over time")
@dataclass(frozen=True, kw_only=True)
class Invert(InvertNeuralRigOptions, FileAction["InverseReport"]):
    """The action."""

    output = "stage of controls over time to write: .usda .usdc .usd .usdz"
    suffixes = (".usda", ".usdc", ".usd", ".usdz")

    rig: Path = source("neural rig: .fpnr")
    target: Path = source(
        "stage with the meshes that it was learned on, posed, animated or with points over time: .usda .usdc ..."
    )
    threshold_mm: float | None = option(
        None, "exit 1 where the mean error of a frame is above this", 0.0, 1e6, "mm", metavar="MM"
    )
    encoder: bool = option(True, "start from the rig's encoder, if it has one")

    def write(self, job: Job) -> InverseReport:
        from facepipe.neural.invert import InvertNeuralRig
        from facepipe.neural.neural_rig_file import has_encoder, load_encoder, load_neural_rig
        from facepipe.neural.read_motion import read_targets
        from facepipe.stage.controls_over_time import save_controls

        rig = load_neural_rig(self.rig)
        targets = read_targets(self.target, rig)
        found, start = InvertNeuralRig(options=self), None
        if self.encoder and self.mode != "adam" and has_encoder(self.rig):
            start = load_encoder(self.rig).values(targets.points)
        with job.watch("invert", found.calls(len(targets.points))) as bar:
            inverted = found(rig, targets.points, start=start, blocks=targets.blocks, done=bar.update)
        save_controls(job.out, rig.controls, inverted.values, targets.codes, targets.codes_per_second)
        report = inverted.report
        if not self.missed(report):
            return report
        off = f"frame {report.worst_frame} is {report.worst_frame_mm:.4f} mm off, more than {self.threshold_mm:g} mm"
        return replace(report, warnings=(*report.warnings, off))

    def missed(self, report: InverseReport) -> bool:
        return self.threshold_mm is not None and report.worst_frame_mm > self.threshold_mm

    def text(self, report: InverseReport, out: Path) -> str:
        errors = (report.error_mean_mm, report.error_rms_mm, report.error_p95_mm, report.error_max_mm)
        rows = [("mm, over all points", "mean", "RMS", "95%", "largest"), ("", *(f"{error:.4f}" for error in errors))]
        frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
        spent = f"{frames}, {report.steps:.1f} steps and {1000.0 * report.seconds_per_frame:.1f} ms each"
        lost, lines = report.not_identifiable, [f"{out}: controls of {spent}", table(rows)]
        if lost:
            more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
            lines.append(f"targets don't determine {', '.join(lost[:_SHOWN])}{more}")
        return "\n".join(lines)
