"""A neural rig authored on a face stage, with a link to its file and the recipe."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from facepipe.core.digests import digest
from facepipe.core.reports import Report
from facepipe.parts import Recipe
from facepipe.processors.neural_rig.attach import AttachNeuralRig
from facepipe.processors.neural_rig.neural_rig_file import load_neural_rig
from facepipe.processors.neural_rig.options import AttachOptions
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.files import relative_path
from facepipe.stage.neural_rig_link import author_neural_rig_link

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


@dataclass(frozen=True, kw_only=True)
class ApplyNeuralRig:
    """A neural rig on a face: its controls are the face's sliders (`AttachNeuralRig`)."""

    file: Path
    options: AttachOptions = field(default_factory=AttachOptions)

    def __call__(
        self, face: Face, out: str | os.PathLike[str], *, recipe: Recipe | None = None
    ) -> ApplyNeuralRigReport:
        """Author it.

        :param out: where the stage of `face` will be saved
        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: a damaged file of a rig, or controls with names that USD can't hold
        :raises TopologyError: other meshes, joints or skin than the rig was learned on
        """
        rig, parts = load_neural_rig(self.file), face.parts()
        attached = AttachNeuralRig(options=self.options)(parts, rig, face.where)
        authored = author_changes(face, replace(attached.parts, recipe=recipe or parts.recipe))
        packed = Path(out).suffix.lower() == ".usdz"
        if not packed:
            file = relative_path(str(self.file), Path(out).absolute().parent)
            author_neural_rig_link(face.prim, file, digest([self.file]), rig.topology)
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
