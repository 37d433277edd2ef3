"""Give a template the shape of a head of others: everything that the template has, and the head's own colours.

HEAD is a head or a body of any tool (.glb .gltf .vrm .fbx .obj .ply .stl .off or USD), of any pose and unit. Of it the
piece that carries nose, mouth and jaw is fitted; hair, hats, glasses, clothes and body are not. Without --template it
becomes the built-in head, textured and ready for use: with -o head.glb for the engine at once. `facepipe transfer` is
the other way round: the head keeps its own mesh.

Landmarks (multipie68, in HEAD's own coordinates) are read from --landmarks, else from HEAD's name with .landmarks.json,
else they are those of HEAD itself, else they are found on it.

OUT is an override layer over --template; --flatten writes a standalone file, as one on the built-in head is. --without
leaves meshes of the template out of it. --picture shows head, face and their distance. Exit code 1: done, but a limit
of the quality gate of `facepipe database add` is missed.

examples:
  facepipe conform hero.glb -o hero_head.glb --picture hero.png
  facepipe conform body.vrm -o head.usdc --without EyeballLeft EyeballRight
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.declare import option, source
from facepipe.kinds import Job, action
from facepipe.scanning.rebuild.fit_neutral_action import FittingAction

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
    from facepipe.scanning.rebuild.scan_fit import Given
    from facepipe.scanning.transfer.head import Head
    from facepipe.stage import Face


@action("conform", "give a template the shape of a head of others", remote=True)
@dataclass(frozen=True, kw_only=True)
class ConformAction(FittingAction):
    """The action."""

    head: Path = source("head or body: .glb .gltf .vrm .fbx .obj .ply .stl .off or USD")
    own_shapes: bool = option(
        False,
        "shapes that HEAD has by any usual name become its own, but for blinks, looks and wide eyes",
        before=False,
    )
    without: tuple[str, ...] = option(
        (), "meshes of the template to leave out: of the built-in head Teeth, EyeballLeft ...", parse=tuple, words=True
    )

    @property
    def fitted(self) -> Path:
        return Path(self.head)

    @cached_property
    def _of_head(self) -> Head:
        from facepipe.scanning.transfer.head import Head

        return Head.of(self._read[0], str(self.head), self.landmarks)

    @cached_property
    def _read(self) -> tuple[FaceParts, tuple[str, ...]]:
        from facepipe.scanning.transfer.head import read_head

        return read_head(Path(self.head))

    def made_base(self) -> tuple[FaceParts, tuple[str, ...]] | None:
        _ = self._read  # read first: the built-in head with its textures takes seconds to make
        return super().made_base()

    def given(self, job: Job) -> Given:
        with job.watch("landmarks", 1) as bar:
            head, warnings = self._of_head, self._read[1]
            bar.update()
        # in the unit of its file, which --unit is of
        scan, unit = head.scan_of_skin(), 1000.0 * head.parts.meters_per_unit
        landmarks = replace(head.landmarks, points=head.landmarks.points / unit)
        return replace(scan, points=scan.points / unit), landmarks, (*warnings, *head.notes), {}

    def author(self, face: Face, job: Job) -> FitNeutralReport:
        names = [mesh.name for mesh in face.meshes]
        for name in self.without:
            if name not in names:
                raise InputError("--without", unknown(name, names, "mesh of the template"))
        left_out = [face.mesh_prim(name) for name in self.without]
        report = super().author(face, job)
        if self.own_shapes:
            report = self._with_own_shapes(face, job, report)
        for prim in left_out:
            prim.SetActive(False)
        return report

    def _with_own_shapes(self, face: Face, job: Job, report: FitNeutralReport) -> FitNeutralReport:
        from facepipe.scanning.transfer.own_shapes import bring_own_shapes
        from facepipe.stage import Face

        place, unit = report.place, 1000.0 * self._of_head.parts.meters_per_unit  # of a scan in the unit of its file
        fitted = Face(face.stage, face.prim)
        with job.watch("shapes", len(fitted.parts().shapes)) as bar:
            placed = replace(place, scale=place.scale / unit)
            names = bring_own_shapes(fitted, self._of_head, placed, report, bar.update)
        return replace(report, own_shapes=names)
