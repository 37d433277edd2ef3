"""Authors named landmarks on a face."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.errors import InputError
from facepipe.parts import Landmarks
from facepipe.reports import Report
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

    :param indices: point index of every landmark, in the order of the scheme
    :param names: empty, or one unique name per landmark
    :param mesh: name of the mesh; default the one with most points
    """

    scheme: str = "multipie68"
    indices: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    mesh: str | None = None

    def __call__(self, face: Face) -> LandmarksReport:
        """Author them.

        :raises InputError: no such mesh, indices out of range or repeated, or names that don't pair
        """
        if not face.meshes:
            raise InputError(face.where, "no meshes, expected one that landmarks can lie on")
        named = {mesh.name: mesh for mesh in face.meshes}
        name = self.mesh or max(named, key=lambda one: len(named[one].points))
        prim = face.mesh_prim(name)
        self._check(f"{face.where} -> {name}", len(named[name].points))
        landmarks = Landmarks(indices=np.array(self.indices, dtype=np.int32), names=self.names)
        author_landmarks(prim, replace(named[name], landmarks={self.scheme: landmarks}, anchor=None))
        return LandmarksReport(scheme=self.scheme, mesh=name, count=len(self.indices))

    def _check(self, where: str, points: int) -> None:
        if not self.scheme.isidentifier():
            raise InputError(where, f"scheme '{self.scheme}', expected letters, digits and underscores")
        if not self.indices:
            raise InputError(where, "no landmarks, expected at least one")
        outside = [index for index in self.indices if not 0 <= index < points]
        if outside:
            raise InputError(where, f"landmark at point {outside[0]}, expected 0 to {points - 1}")
        if self.names and (len(self.names) != len(self.indices) or len(set(self.names)) != len(self.names)):
            raise InputError(where, f"{len(self.names)} names, expected {len(self.indices)} different ones")
