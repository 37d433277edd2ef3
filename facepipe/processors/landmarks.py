"""Authors named landmarks on a face."""

from __future__ import annotations

from dataclasses import dataclass, replace

from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.core.reports import Report
from facepipe.parts import Landmarks, Mesh
from facepipe.stage import Face
from facepipe.stage.author_mesh import author_landmarks


@dataclass(frozen=True, kw_only=True)
class LandmarksReport(Report):
    """What was authored."""

    scheme: str
    mesh: str
    count: int


@dataclass(frozen=True, kw_only=True)
class SetLandmarks:
    """Landmarks of one scheme on one mesh; those it had of that scheme are replaced.

    :param mesh: name of the mesh; default the one with most points
    """

    landmarks: Landmarks
    scheme: str = "multipie68"
    mesh: str | None = None

    def __call__(self, face: Face) -> LandmarksReport:
        """Author them.

        :raises InputError: no such mesh, no landmarks, indices out of range, or names that don't pair
        """
        mesh = mesh_of(face, self.mesh)
        self._check(f"{face.where} -> {mesh.name}", len(mesh.points))
        author_landmarks(face.mesh_prim(mesh.name), replace(mesh, landmarks={self.scheme: self.landmarks}, anchor=None))
        return LandmarksReport(scheme=self.scheme, mesh=mesh.name, count=len(self.landmarks.indices))

    def _check(self, where: str, points: int) -> None:
        indices, names = self.landmarks.indices, self.landmarks.names
        if not (self.scheme.isascii() and self.scheme.isidentifier()):
            raise InputError(where, f"scheme '{self.scheme}', expected letters, digits and underscores")
        if not len(indices) or indices.min() < 0 or indices.max() >= points:
            raise InputError(where, f"{len(indices)} landmarks, expected at least one, all at points 0 to {points - 1}")
        if names and (len(names) != len(indices) or len(set(names)) != len(names)):
            raise InputError(where, f"{len(names)} names, expected {len(indices)} different ones")


def mesh_of(face: Face, name: str | None) -> Mesh:
    """The mesh called `name`, or the one with most points.

    :raises InputError: no such mesh, or none at all
    """
    named = {mesh.name: mesh for mesh in face.meshes}
    if not named or (name is not None and name not in named):
        raise InputError(face.where, unknown(name or "", named, "mesh"))
    return named[name] if name is not None else max(named.values(), key=lambda mesh: len(mesh.points))
