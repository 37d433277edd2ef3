"""Author named landmarks on a face; OUT is an override layer over FACE.

The file holds a list of point indices, an object {"name": index}, {"scheme": ..., "indices": [...], "names": [...]},
or an object of several schemes, each a list or an object. A scheme without name is multipie68.

example: facepipe landmarks head.usdc --from points.json -o head.landmarks.usda
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.core.reports import Report
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.parts import Mesh
    from facepipe.stage import Face


@dataclass(frozen=True, kw_only=True)
class LandmarksReport(Report):
    """What was authored."""

    schemes: Mapping[str, int]  # scheme -> its landmarks
    mesh: str


@action("landmarks", "author named landmarks", remote=True)
@dataclass(frozen=True, kw_only=True)
class AuthorLandmarks(StageAction[LandmarksReport]):
    """The action."""

    face: Path = source("face stage")
    landmarks: Path = source("landmarks to author", flag="--from", metavar="JSON")
    scheme: str | None = option(None, "name of the scheme, where the file holds one (default: the file's)")
    mesh: str | None = option(None, "mesh they lie on (default: the one with most points)")

    def author(self, face: Face, job: Job) -> LandmarksReport:
        from facepipe.importers.obj import read_landmarks
        from facepipe.stage.author_mesh import author_landmarks
        from facepipe.stage.skeleton import author_recipe

        recipe, mesh = job.recipe(), mesh_of(face, self.mesh)
        schemes = read_landmarks(self.landmarks, len(mesh.points))
        if self.scheme and len(schemes) > 1:
            raise InputError(self.landmarks, f"{len(schemes)} schemes, expected one where --scheme names it")
        named = {self.scheme or scheme: landmarks for scheme, landmarks in schemes.items()}
        where, points = f"{face.where} -> {mesh.name}", len(mesh.points)
        for scheme, landmarks in named.items():
            indices, names = landmarks.indices, landmarks.names
            if not (scheme.isascii() and scheme.isidentifier()):
                raise InputError(where, f"scheme '{scheme}', expected letters, digits and underscores")
            if not len(indices) or indices.min() < 0 or indices.max() >= points:
                what = f"{len(indices)} landmarks, expected at least one, all at points 0 to {points - 1}"
                raise InputError(where, what)
            if names and (len(names) != len(indices) or len(set(names)) != len(names)):
                raise InputError(where, f"{len(names)} names, expected {len(indices)} different ones")
            # only this scheme is authored: those of others, and the mesh's anchor, stay as they are on the stage
            author_landmarks(face.mesh_prim(mesh.name), replace(mesh, landmarks={scheme: landmarks}, anchor=None))
        author_recipe(face.prim, recipe)
        counts = {scheme: len(landmarks.indices) for scheme, landmarks in named.items()}
        return LandmarksReport(schemes=counts, mesh=mesh.name)

    def text(self, report: LandmarksReport, out: Path) -> str:
        return "\n".join(
            f"{out}: {count} landmarks of {scheme} on {report.mesh}" for scheme, count in report.schemes.items()
        )


def mesh_of(face: Face, name: str | None) -> Mesh:
    """The mesh called `name`, or the one with most points.

    :raises InputError: no such mesh, or none at all
    """
    named = {mesh.name: mesh for mesh in face.meshes}
    if not named or (name is not None and name not in named):
        raise InputError(face.where, unknown(name or "", named, "mesh"))
    return named[name] if name is not None else max(named.values(), key=lambda mesh: len(mesh.points))
