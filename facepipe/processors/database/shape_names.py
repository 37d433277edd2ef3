"""Which shapes the expressions of a database are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from facepipe.processors.database.face_checks import Facts
from facepipe.processors.database.face_database import FaceDatabase


class Shapes(NamedTuple):
    """Those that all faces have that have any, and what became of the others."""

    names: tuple[str, ...]
    meshes: Mapping[str, tuple[str, ...]]  # of each, those that it moves in some face
    left_out: Mapping[str, tuple[str, ...]]  # shape -> the entries that have expressions and lack it
    dropped: tuple[str, ...]  # those of the database before that are no more
    warnings: tuple[str, ...]


def shapes_in_common(database: FaceDatabase | None, facts: Sequence[Facts]) -> Shapes:
    """The shapes of the entries of a database and of faces that come to it."""
    coming = [one for one in facts if one.shapes]
    former = _people(database)
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
        meshes={shape: _meshes(shape, database, coming) for shape in names},
        left_out=left_out,
        dropped=tuple(shape for shape in before if shape not in names) if former else (),
        warnings=tuple(warnings),
    )


def _people(database: FaceDatabase | None) -> list[str]:
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


def _meshes(shape: str, database: FaceDatabase | None, coming: Sequence[Facts]) -> tuple[str, ...]:
    old = database.shape_meshes.get(shape, ()) if database else ()
    return tuple(dict.fromkeys((*old, *(mesh for one in coming for mesh in one.shapes[shape]))))


def _few(names: Sequence[str]) -> str:
    return f"{', '.join(names[:3])} and {len(names) - 3} more" if len(names) > 3 else ", ".join(names)
