"""What must hold of faces that come to a database."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.similarity import fit_similarity
from facepipe.processors.database.face_database import FaceDatabase
from facepipe.processors.database.whole_faces import Topology, WholeFace

_SCALES = 2.0  # how much larger or smaller a face may be: more is another unit
_TURNED, _SHIFTED = 15.0, 50.0  # degrees and millimetres, beyond what faces of one place differ by


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What is kept of a face between its two readings."""

    name: str
    topology: Topology
    points: FloatArray  # (n, 3)
    shapes: Mapping[str, tuple[str, ...]]  # shape -> meshes that it moves
    source: str
    digest: str
    content: str
    warnings: tuple[str, ...]


def facts_of(face: WholeFace) -> Facts:
    """:raises InputError: NaN or infinity"""
    require_finite(face.points, face.name)
    require_finite(face.deltas, face.name)
    return Facts(
        name=face.name,
        topology=face.topology,
        points=face.points,
        shapes={name: face.meshes.get(name, ()) for name in face.deltas},
        source=face.source,
        digest=face.digest,
        content=face.content,
        warnings=face.warnings,
    )


def check_faces(database: FaceDatabase | None, facts: Sequence[Facts]) -> None:
    """Check that faces are of one topology, size and place, and each is new.

    :raises InputError: a name or a face twice, or a face of another size or place
    :raises TopologyError: another topology
    """
    topology = database.topology if database else facts[0].topology
    mean = database.identity.mean if database else facts[0].points
    entries = database.entries if database else ()
    names = {one.name: "the database" for one in entries}
    known = {one.content: one.name for one in entries} | {one.digest: one.name for one in entries if one.digest}
    for one in facts:
        if one.topology.digest != topology.digest:
            raise TopologyError(one.name, f"{one.topology.digest[:14]} of meshes, expected {topology.digest[:14]}")
        twin = known.get(one.content) or known.get(one.digest or one.content)
        if twin is not None:
            raise InputError(one.name, f"is the same face as {twin}, expected each face once")
        if one.name in names:
            raise InputError(one.name, f"a face of that name is in {names[one.name]} too, expected another name")
        _check_place(one, np.asarray(mean, np.float64))
        names[one.name] = "the line"
        known |= {one.content: one.name} | ({one.digest: one.name} if one.digest else {})


def _check_place(one: Facts, mean: FloatArray) -> None:
    """:raises InputError: a face that stands elsewhere: what is place would enter the model as identity"""
    fitted = fit_similarity(mean, one.points)
    angle = float(np.degrees(np.arccos(np.clip((np.trace(fitted.rotation) - 1) / 2, -1, 1))))
    shift = float(np.linalg.norm(one.points.mean(axis=0) - mean.mean(axis=0)))
    if not 1 / _SCALES < fitted.scale < _SCALES:
        raise InputError(one.name, f"{fitted.scale:.3g} times as large as the others, expected metersPerUnit to say so")
    if angle > _TURNED or shift > _SHIFTED:
        what = f"stands {shift:.0f} mm and {angle:.0f} degrees away from the others"
        raise InputError(one.name, f"{what}, expected faces in one place")


def mesh_warnings(facts: Sequence[Facts], meshes: Mapping[str, tuple[str, ...]]) -> list[str]:
    """A line for each face with shapes that leave meshes still which they move in other faces."""
    lines = []
    for one in facts:
        still = [
            f"{shape} ({', '.join(lost)})"
            for shape, known in meshes.items()
            if shape in one.shapes and (lost := [mesh for mesh in known if mesh not in one.shapes[shape]])
        ]
        if still:
            lines.append(f"{one.name}: meshes that stay still, unlike in other faces: {', '.join(still)}")
    return lines
