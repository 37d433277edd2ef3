"""Authors named landmarks on a face."""

from __future__ import annotations

from collections.abc import Mapping
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

    schemes: Mapping[str, int]  # scheme -> its landmarks
    mesh: str


def set_landmarks(face: Face, mesh: Mesh, scheme: str, landmarks: Landmarks) -> None:
    """Author landmarks of one scheme on a mesh; those it had of that scheme are replaced.

    :raises InputError: no landmarks, indices out of range, or names that don't pair
    """
    where, points = f"{face.where} -> {mesh.name}", len(mesh.points)
    indices, names = landmarks.indices, landmarks.names
    if not (scheme.isascii() and scheme.isidentifier()):
        raise InputError(where, f"scheme '{scheme}', expected letters, digits and underscores")
    if not len(indices) or indices.min() < 0 or indices.max() >= points:
        raise InputError(where, f"{len(indices)} landmarks, expected at least one, all at points 0 to {points - 1}")
    if names and (len(names) != len(indices) or len(set(names)) != len(names)):
        raise InputError(where, f"{len(names)} names, expected {len(indices)} different ones")
    author_landmarks(face.mesh_prim(mesh.name), replace(mesh, landmarks={scheme: landmarks}, anchor=None))


def mesh_of(face: Face, name: str | None) -> Mesh:
    """The mesh called `name`, or the one with most points.

    :raises InputError: no such mesh, or none at all
    """
    named = {mesh.name: mesh for mesh in face.meshes}
    if not named or (name is not None and name not in named):
        raise InputError(face.where, unknown(name or "", named, "mesh"))
    return named[name] if name is not None else max(named.values(), key=lambda mesh: len(mesh.points))
