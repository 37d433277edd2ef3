"""Put a neural rig on a face of the meshes that it was learned on: its controls are sliders beside all that it has.

OUT is an override layer over FACE that links the rig; `facepipe export --neural` writes what an engine loads.

example: facepipe neural-rig apply head.usdc head.fpnr -o neural.usda
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import Report
from facepipe.declare import source
from facepipe.kinds import Job, StageAction, action
from facepipe.neural.options import AttachOptions

if TYPE_CHECKING:
    from facepipe.stage import Face

_NO_LINK = ("a .usdz can't hold a neural rig: it has no link to the file",)


@dataclass(frozen=True, kw_only=True)
class ApplyNeuralRigReport(Report):
    """What was authored."""

    controls: int
    channels: int  # of bones that move
    shapes: int
    units: int  # of the hidden layer
    offsets: int  # of all shapes and meshes
    dropped_mm: float  # by which points can be off for offsets that are left out
    clips_mm: float  # by which points of clips are off at most
    authored: tuple[str, ...] = ()


@action("neural-rig apply", "put a neural rig on a face: its controls are sliders")
@dataclass(frozen=True, kw_only=True)
class ApplyNeuralRig(AttachOptions, StageAction[ApplyNeuralRigReport]):
    """The action (`AttachNeuralRig`); the stage links the file of the rig, which `neural_rig_link` reads."""

    face: Path = source("face stage of the meshes that it was learned on")
    rig: Path = source("neural rig: .fpnr")

    def author(self, face: Face, job: Job) -> ApplyNeuralRigReport:
        from facepipe.core.reading import digest
        from facepipe.neural.attach import AttachNeuralRig
        from facepipe.neural.neural_rig_file import load_neural_rig
        from facepipe.stage.author_changes import author_changes
        from facepipe.stage.files import relative_path
        from facepipe.stage.recipes import author_neural_rig_link

        recipe, rig = job.recipe(), load_neural_rig(self.rig)
        attached = AttachNeuralRig(options=self)(face.parts(), rig, face.where)
        authored = author_changes(face, replace(attached.parts, recipe=recipe))
        packed = job.out.suffix.lower() == ".usdz"
        if not packed:
            file = relative_path(str(self.rig), job.out.absolute().parent)
            author_neural_rig_link(face.prim, file, digest([self.rig]), rig.topology)
        return ApplyNeuralRigReport(
            controls=len(rig.controls),
            channels=len(rig.channels),
            shapes=attached.shapes,
            units=len(rig.hidden),
            offsets=attached.offsets,
            dropped_mm=attached.dropped_mm,
            clips_mm=attached.clips_mm,
            authored=authored,
            warnings=(*attached.warnings, *(_NO_LINK if packed else ())),
        )

    def text(self, report: ApplyNeuralRigReport, out: Path) -> str:
        summary = f"{report.controls} sliders over {report.channels} channels and {report.shapes} shapes"
        left = f"{report.offsets:,} offsets, without those that are left out points are off by at most "
        clips = f", in clips by {report.clips_mm:.4f} mm" if report.clips_mm else ""
        return f"{out}: {summary}, {report.units} units; {left}{report.dropped_mm:.4f} mm{clips}"
