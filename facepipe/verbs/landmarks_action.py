"""Author named landmarks on a face; OUT is an override layer over FACE.

The file holds a list of point indices, an object {"name": index}, {"scheme": ..., "indices": [...], "names": [...]},
or an object of several schemes, each a list or an object. A scheme without name is multipie68.

example: facepipe landmarks head.usda --from points.json -o head.landmarks.usda
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.landmarks import LandmarksReport


@action("landmarks", "author named landmarks")
@dataclass(frozen=True, kw_only=True)
class AuthorLandmarks(StageAction["LandmarksReport"]):
    """The action."""

    face: Path = source("face stage")
    landmarks: Path = source("landmarks to author", flag="--from", metavar="JSON")
    scheme: str | None = option(None, "name of the scheme, where the file holds one (default: the file's)")
    mesh: str | None = option(None, "mesh they lie on (default: the one with most points)")

    def author(self, face: Face, job: Job) -> LandmarksReport:
        from facepipe.importers.obj import read_landmarks
        from facepipe.stage.skeleton import author_recipe
        from facepipe.verbs.landmarks import LandmarksReport, mesh_of, set_landmarks

        recipe, mesh = job.recipe(), mesh_of(face, self.mesh)
        schemes = read_landmarks(self.landmarks, len(mesh.points))
        if self.scheme and len(schemes) > 1:
            raise InputError(self.landmarks, f"{len(schemes)} schemes, expected one where --scheme names it")
        named = {self.scheme or scheme: landmarks for scheme, landmarks in schemes.items()}
        for scheme, landmarks in named.items():
            set_landmarks(face, mesh, scheme, landmarks)
        author_recipe(face.prim, recipe)
        counts = {scheme: len(landmarks.indices) for scheme, landmarks in named.items()}
        return LandmarksReport(schemes=counts, mesh=mesh.name)

    def text(self, report: LandmarksReport, out: Path) -> str:
        return "\n".join(
            f"{out}: {count} landmarks of {scheme} on {report.mesh}" for scheme, count in report.schemes.items()
        )
