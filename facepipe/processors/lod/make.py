"""Levels of a face made, measured and authored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.reports import Report, table
from facepipe.kinds import Watch
from facepipe.parts import Mesh
from facepipe.processors.lod.decimate import Surface
from facepipe.processors.lod.errors import Distances, FullFace, LevelErrors
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
    surface = Surface(face.parts(), face.rig())
    total = len(surface.triangles)
    counts = _checked(face, counts or [round(share * total) for share in _SHARES], total)
    full = FullFace(face.rig(), surface.triangles, surface.is_skin, surface.cards >= 0, face.mm_per_unit)
    rows = [surface.full]
    with watch("levels", len(counts) + full.poses) as bar:
        for count in counts:
            rows.append(surface.level(count, skin_share, rows[-1]))
            bar.update()
        errors = full.errors([(surface.points_of(one), surface.places(one)) for one in rows[1:]], bar.update)
    made = [surface.meshes(one) for one in rows[1:]]
    author_levels(face, made)
    each = zip(made, (surface.skin_triangles(one) for one in rows[1:]), errors, strict=True)
    levels = tuple(_level(f"lod{number}", *one) for number, one in enumerate(each, 1))
    return LodReport(triangles=total, levels=levels, warnings=tuple(_warnings(levels, counts)))


def _checked(face: Face, counts: Sequence[int], total: int) -> list[int]:
    for above, count in zip([total, *counts], counts, strict=False):
        if not 0 < count < above:
            expected = f"expected fewer than {above:,}, what is above it has" if count > 0 else "expected some"
            raise InputError(f"{face.where} -> level of {count:,} triangles", expected)
    return list(counts)


def _level(name: str, meshes: Sequence[Mesh], skin_triangles: int, errors: LevelErrors) -> Level:
    counts = {mesh.name: len(mesh.face_vertex_counts) for mesh in meshes}
    return Level(
        name=name,
        triangles=sum(counts.values()),
        skin_triangles=skin_triangles,
        points=sum(len(mesh.points) for mesh in meshes),
        meshes=counts,
        errors=errors,
    )


def _warnings(levels: Sequence[Level], counts: Sequence[int]) -> Iterator[str]:
    for level, count in zip(levels, counts, strict=True):
        if level.triangles > _MISSED * count:
            yield f"{level.name}: {level.triangles:,} triangles, {count:,} can't be reached: seams and borders stay"
        if level.errors.lost:
            gone = ", ".join(f"{name} ({points:,})" for name, points in level.errors.lost.items())
            yield f"{level.name}: some pieces have no triangle left, and no error counts them (points): {gone}"


def lod_text(report: LodReport, out: Path) -> str:
    """The levels as a table."""
    rows: list[list[object]] = [
        ["level", "triangles", "of skin", "points", "mm off at rest", "shapes", "on the skin", "joints"]
    ]
    for level in report.levels:
        errors = level.errors
        rest, *moved = ({"rest": errors.rest}, errors.shapes, errors.skin_shapes, errors.joints)
        counts = (f"{count:,}" for count in (level.triangles, level.skin_triangles, level.points))
        rows.append([level.name, *counts, _worst(rest).partition(" (")[0], *map(_worst, moved)])
    lines = [
        f"{out}: {report.triangles:,} triangles; its levels:",
        table(rows),
        "mean / 95 % of the points, worst first",
    ]
    for level in report.levels:
        for mesh, gone in level.errors.cards.items():
            away = f"{gone.mean_mm:.2f} / {gone.p95_mm:.2f} mm from those that stay"
            lines.append(f"{level.name}: points of cards of {mesh} that are left out (not in the errors above): {away}")
    return "\n".join(lines)


def _worst(distances: Mapping[str, Distances]) -> str:
    """The largest mean and 95th percentile, and whose they are."""
    if not distances:
        return "-"
    names = [max(distances, key=lambda name: getattr(distances[name], key)) for key in ("mean_mm", "p95_mm")]
    mean, p95 = distances[names[0]].mean_mm, distances[names[1]].p95_mm
    return f"{mean:.2f} / {p95:.2f} ({', '.join(dict.fromkeys(name.rpartition('/')[2] for name in names))})"
