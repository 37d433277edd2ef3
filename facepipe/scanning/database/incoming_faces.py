"""Faces that come to a database: read when they are wanted, so that one is in memory at a time; what must hold of them;
and the shapes that all have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.similarity import fit_similarity
from facepipe.kinds import found_of
from facepipe.rig import set_face
from facepipe.scanning.database.face_database import FaceDatabase
from facepipe.scanning.database.options import Quality, quality_from
from facepipe.stage import open_face
from facepipe.stage.recipes import file_recipe, source_digest
from facepipe.verbs.whole_faces import Topology, WholeFace, whole_face

REBUILT = "rebuild"  # the verb of recipes that state measures
_SCALES = 2.0  # how much larger or smaller a face may be: more is another unit
_TURNED, _SHIFTED = 15.0, 50.0  # degrees and millimetres, beyond what faces of one place differ by


@dataclass
class StageSource:
    """One face stage, read anew by each call."""

    path: Path
    name: str
    base: StageSource | Topology | None = None  # whose meshes it must have, in which order
    base_name: str = ""
    _topology: Topology | None = None

    def __call__(self) -> WholeFace:
        """:raises FacepipeError: a file that can't be read, or another topology"""
        base = self.base.topology() if isinstance(self.base, StageSource) else self.base
        face = whole_face(set_face(open_face(self.path).parts()).parts, str(self.path), base, self.base_name)
        self._topology = face.topology
        return replace(face, name=self.name, source=self.path.name, digest=source_digest(self.path))

    def topology(self) -> Topology:
        """Its meshes."""
        return self._topology or self().topology

    def quality(self) -> Quality | None:
        """The measures on a rebuilt face; None on a face made otherwise.

        :raises InputError: a rebuilt face without them
        """
        recipe = file_recipe(self.path).recipe
        if recipe is None or recipe.verb != REBUILT:
            return None
        results = found_of(recipe)
        if "quality" not in results:
            what = "is rebuilt and states no quality, expected it in its recipe (or --quality, or --ignore-quality)"
            raise InputError(self.path, what)
        return quality_from(results["quality"], f"{self.path} -> recipe -> quality")


def stage_sources(
    paths: Sequence[Path], names: Sequence[str] = (), database: FaceDatabase | None = None, where: str = "the database"
) -> list[StageSource]:
    """Face stages as sources, on the topology of `database`, or of the first of them.

    :param names: one for each; those of the files by default
    :raises InputError: names that are not one for each, or twice
    """
    face_names = list(names) or [path.stem for path in paths]
    if len(face_names) != len(paths):
        raise InputError("names", f"{len(face_names)} names, expected {len(paths)}, one a face")
    for number, name in enumerate(face_names):
        if not name.strip() or name in face_names[:number]:
            raise InputError(paths[number], f"name '{name}' empty or twice, expected another by --names")
    sources: list[StageSource] = []
    for path, name in zip(paths, face_names, strict=True):
        base: StageSource | Topology | None = database.topology if database else sources[0] if sources else None
        base_name = where if database else str(paths[0])
        sources.append(StageSource(path=path, name=name, base=base, base_name=base_name))
    return sources


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
    names = {entry.name: "the database" for entry in entries}
    known = {entry.content: entry.name for entry in entries} | {
        entry.digest: entry.name for entry in entries if entry.digest
    }
    for face in facts:
        if face.topology.digest != topology.digest:
            raise TopologyError(face.name, f"{face.topology.digest[:14]} of meshes, expected {topology.digest[:14]}")
        twin = known.get(face.content) or known.get(face.digest or face.content)
        if twin is not None:
            raise InputError(face.name, f"is the same face as {twin}, expected each face once")
        if face.name in names:
            raise InputError(face.name, f"a face of that name is in {names[face.name]} too, expected another name")
        _check_place(face, np.asarray(mean, np.float64))
        names[face.name] = "the line"
        known |= {face.content: face.name} | ({face.digest: face.name} if face.digest else {})


def _check_place(face: Facts, mean: FloatArray) -> None:
    """:raises InputError: a face that stands elsewhere: what is place would enter the model as identity"""
    fitted = fit_similarity(mean, face.points)
    angle = float(np.degrees(np.arccos(np.clip((np.trace(fitted.rotation) - 1) / 2, -1, 1))))
    shift = float(np.linalg.norm(face.points.mean(axis=0) - mean.mean(axis=0)))
    if not 1 / _SCALES < fitted.scale < _SCALES:
        raise InputError(
            face.name, f"{fitted.scale:.3g} times as large as the others, expected metersPerUnit to say so"
        )
    if angle > _TURNED or shift > _SHIFTED:
        what = f"stands {shift:.0f} mm and {angle:.0f} degrees away from the others"
        raise InputError(face.name, f"{what}, expected faces in one place")


def mesh_warnings(facts: Sequence[Facts], meshes: Mapping[str, tuple[str, ...]]) -> list[str]:
    """A line for each face with shapes that leave meshes still which they move in other faces."""
    lines = []
    for face in facts:
        still = [
            f"{shape} ({', '.join(lost)})"
            for shape, known in meshes.items()
            if shape in face.shapes and (lost := [mesh for mesh in known if mesh not in face.shapes[shape]])
        ]
        if still:
            lines.append(f"{face.name}: meshes that stay still, unlike in other faces: {', '.join(still)}")
    return lines


class Shapes(NamedTuple):
    """Those that all faces have that have any, and what became of the others."""

    names: tuple[str, ...]
    meshes: Mapping[str, tuple[str, ...]]  # of each, those that it moves in some face
    left_out: Mapping[str, tuple[str, ...]]  # shape -> the entries that have expressions and lack it
    dropped: tuple[str, ...]  # those of the database before that are no more
    warnings: tuple[str, ...]


def shapes_in_common(database: FaceDatabase | None, facts: Sequence[Facts]) -> Shapes:
    """The shapes of the entries of a database and of faces that come to it."""
    coming = [fact for fact in facts if fact.shapes]
    former = _with_expressions(database)
    before = database.shapes if database and former else _first_names(coming)
    names = tuple(shape for shape in before if all(shape in one.shapes for one in coming))
    seen = dict.fromkeys(
        (*before, *(database.left_out if database else ()), *(s for one in coming for s in one.shapes))
    )
    left_out = {shape: _lacking(shape, database, former, coming) for shape in seen if shape not in names}
    warnings = [f"{one.name}: has no shapes, and enters the identity model alone" for one in facts if not one.shapes]
    if left_out:
        some = ", ".join(f"{shape} ({_few(lacking)})" for shape, lacking in sorted(left_out.items()))
        warnings.append(f"shapes left out, as faces lack them: {some}")
    return Shapes(
        names=names,
        meshes={shape: _moved_meshes(shape, database, coming) for shape in names},
        left_out=left_out,
        dropped=tuple(shape for shape in before if shape not in names) if former else (),
        warnings=tuple(warnings),
    )


def _with_expressions(database: FaceDatabase | None) -> list[str]:
    """Entries whose expressions count."""
    return [entry.name for entry in database.entries if entry.stored_error is not None] if database else []


def _first_names(coming: Sequence[Facts]) -> tuple[str, ...]:
    return tuple(coming[0].shapes) if coming else ()


def _lacking(
    shape: str, database: FaceDatabase | None, former: Sequence[str], coming: Sequence[Facts]
) -> tuple[str, ...]:
    known = database is not None and shape in database.shapes
    old: Sequence[str] = () if known or database is None else database.left_out.get(shape, tuple(former))
    return (*old, *(one.name for one in coming if shape not in one.shapes))


def _moved_meshes(shape: str, database: FaceDatabase | None, coming: Sequence[Facts]) -> tuple[str, ...]:
    old = database.shape_meshes.get(shape, ()) if database else ()
    return tuple(dict.fromkeys((*old, *(mesh for one in coming for mesh in one.shapes[shape]))))


def _few(names: Sequence[str]) -> str:
    return f"{', '.join(names[:3])} and {len(names) - 3} more" if len(names) > 3 else ", ".join(names)
