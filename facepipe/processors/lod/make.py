"""Levels of a face made, measured and authored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from facepipe.core.arrays import IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.kinds import Watch
from facepipe.parts import Mesh
from facepipe.processors.lod.decimate import Surface
from facepipe.processors.lod.errors import FullFace, LevelErrors
from facepipe.stage import Face
from facepipe.stage.levels import author_levels

_SHARES = (0.4, 0.15, 0.05)  # of the face's triangles, where no numbers are given
_MISSED = 1.05  # a level may have so many times the triangles that were asked for


@dataclass(frozen=True, kw_only=True)
class Level:
    """A lower level of a face."""

    name: str  # of its variant
    triangles: int
    skin_triangles: int
    points: int
    meshes: Mapping[str, int]  # mesh -> triangles
    errors: LevelErrors


@dataclass(frozen=True, kw_only=True)
class LodReport(Report):
    """The levels of a face, finest first."""

    triangles: int  # of the face itself
    levels: tuple[Level, ...]


def make_levels(face: Face, counts: Sequence[int], skin_share: float, watch: Watch) -> LodReport:
    """Author levels of at most `counts` triangles on a face over an override layer; none: some that suit it.

    :raises InputError: levels already there, no triangles, or counts that do not fall from the face's
    """
    if face.levels:
        raise InputError(face.where, "has levels of detail, expected a face without (or --edit, to make them anew)")
    if not any(len(mesh.face_vertex_counts) for mesh in face.meshes):
        raise InputError(face.where, "no triangles, expected a surface")
    surface = Surface(face.meshes, face.rig())
    total = len(surface.triangles)
    counts = _checked(face, counts or [round(share * total) for share in _SHARES], total)
    full = FullFace(face.rig(), surface.triangles, face.mm_per_unit)
    made, reports, rows = [], [], surface.full
    with watch("levels", len(counts)) as bar:
        for number, count in enumerate(counts, 1):
            rows = surface.level(count, skin_share, rows)
            made.append(surface.meshes(rows))
            reports.append(_level(f"lod{number}", face.meshes, made[-1], surface, rows, full))
            bar.update()
    author_levels(face, made)
    return LodReport(triangles=total, levels=tuple(reports), warnings=tuple(_warnings(reports, counts)))


def _checked(face: Face, counts: Sequence[int], total: int) -> list[int]:
    for above, count in zip([total, *counts], counts, strict=False):
        if not 0 < count < above:
            expected = f"expected fewer than {above:,}, what is above it has" if count > 0 else "expected some"
            raise InputError(f"{face.where} -> level of {count:,} triangles", expected)
    return list(counts)


def _level(
    name: str, meshes: Sequence[Mesh], made: Sequence[Mesh], surface: Surface, rows: IntArray, full: FullFace
) -> Level:
    counts = [len(one.face_vertex_counts) for one in made]
    return Level(
        name=name,
        triangles=sum(counts),
        skin_triangles=surface.skin_triangles(rows),
        points=sum(len(one.points) for one in made),
        meshes={mesh.name: count for mesh, count in zip(meshes, counts, strict=True)},
        errors=full.errors(surface.points_of(rows)),
    )


def _warnings(levels: Sequence[Level], counts: Sequence[int]) -> Iterator[str]:
    for level, count in zip(levels, counts, strict=True):
        if level.triangles > _MISSED * count:
            yield f"{level.name}: {level.triangles:,} triangles, {count:,} can't be reached: seams and borders stay"
