"""Levels of a face made and authored, and how far off each is at rest, in every shape, and with joints turned."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report, Watch, table
from facepipe.geometry.closest_points import closest_among, closest_places, place_shares
from facepipe.geometry.geodesics import nearest_sources, surface_graph
from facepipe.geometry.vectors import transformed_each
from facepipe.rig import Rig, rest_coefficients
from facepipe.stage import Face
from facepipe.stage.author_changes import author_levels
from facepipe.verbs.lod.decimate import Surface

_MOVED = 0.1  # mm
_TURN = 0.35  # radians


@dataclass(frozen=True, kw_only=True)
class Distances:
    """Distances of points of the full face from their places on a level."""

    points: int
    mean_mm: float
    p95_mm: float
    max_mm: float


@dataclass(frozen=True, kw_only=True)
class LevelErrors:
    """Of all points at rest; of those that a shape at 1, or a joint turned by 20 degrees, moves by 0.1 mm or more."""

    rest: Distances
    shapes: Mapping[str, Distances]
    skin_shapes: Mapping[str, Distances]  # of the skin alone
    joints: Mapping[str, Distances]
    cards: Mapping[str, Distances]  # mesh -> points of its cards that are gone, from what is left of it, at rest
    lost: Mapping[str, int]  # mesh -> points of other connected pieces that the level has no triangle of


class _Places(NamedTuple):
    """Where the points of the full face are on a level."""

    rows: IntArray  # (r,) points that have one
    corners: IntArray  # (3, r) points of the level about each
    shares: FloatArray  # (3, r) of these
    off: FloatArray  # (3, r) from the places to the points, at rest


class FullFace:
    """The points of a full face, posed, to measure its levels against."""

    def __init__(
        self, rig: Rig, triangles: IntArray, is_skin: BoolArray, is_card: BoolArray, mm_per_unit: float
    ) -> None:
        """:param triangles: (t, 3) of the points of all meshes; `is_skin` and `is_card` (t,) of them"""
        self._rig, self._mm = rig, mm_per_unit
        self._rest = rig.evaluate()
        self._used = np.unique(triangles)
        self._skin, self._card = (np.isin(np.arange(len(self._rest)), triangles[one]) for one in (is_skin, is_card))
        self._graph = surface_graph(self._rest, np.pad(triangles, ((0, 0), (0, 1)), constant_values=-1))

    @property
    def poses(self) -> int:
        """How many there are to measure in."""
        return len(self._rig.shapes) + len(self._rig.joints)

    def errors(self, levels: Sequence[tuple[IntArray, FloatArray]], step: Callable[[], object]) -> list[LevelErrors]:
        """Of levels, each triangles (t, 3) of points of the face, and where these are at the level, (n, 3) of the rig.

        A point's place is the nearest one on the triangles about the point of the level that is nearest to it along
        the surface, so that it is on its own lip, lid and part; the place then moves with the corners of its triangle.
        A point of a piece that the level lacks has no place, and is in no error; of a card, its distance at rest from
        what is left of its mesh is.

        :param step: called after every pose
        """
        rig = self._rig
        matrices = rig.skinning_matrices(rig.rest)
        blended = rig.blended(matrices)
        linear = np.ascontiguousarray(blended[:, :, :3].transpose(1, 2, 0))
        rest = [transformed_each(points, blended) for _, points in levels]
        places = [
            _places(self._rest, at, self._graph, one, self._used) for at, (one, _) in zip(rest, levels, strict=True)
        ]
        shapes, skin, joints = ([dict[str, Distances]() for _ in levels] for _ in range(3))
        for name in rig.shapes:
            offsets = rig.offsets(rig.weight_vector({name: 1.0}))
            changed = np.flatnonzero((offsets != 0) @ np.ones(3, bool))
            # a shape adds the same at both places, so no level is posed for it; a joint's turn does not
            x, y, z = offsets.take(changed, axis=0).T
            away = np.stack([x * a.take(changed) + y * b.take(changed) + z * c.take(changed) for a, b, c in linear])
            for number, (rows, mm) in enumerate(self._off(places, changed, away, [away] * len(levels))):
                shapes[number][name] = _distances(mm)
                skin[number][name] = _distances(mm[self._skin[rows]])
            step()
        influences = rig.influences.tocsc()
        for joint, name in enumerate(rig.joints):
            coefficients = rest_coefficients(len(rig.joints))
            coefficients[joint, 3] = _TURN
            turned = rig.skinning_matrices(rig.local_transforms(coefficients))
            changed = np.unique(influences[:, np.flatnonzero((turned != matrices).any(axis=(1, 2)))].indices)
            turn = rig.blended(turned, changed) - blended[changed]
            away, *aways = (transformed_each(one[changed], turn).T for one in (rig.points, *(at for _, at in levels)))
            for number, (_, mm) in enumerate(self._off(places, changed, away, aways)):
                joints[number][name] = _distances(mm)
            step()
        measured = []
        for number, (placed, at) in enumerate(zip(places, rest, strict=True)):
            # pieces that are gone, cards apart: those are far from what is left by intent
            gone = self._by_mesh(np.setdiff1d(self._used[~self._card[self._used]], placed.rows))
            measured.append(
                LevelErrors(
                    rest=_distances(_lengths(placed.off) * self._mm),
                    shapes=shapes[number],
                    skin_shapes=skin[number],
                    joints=joints[number],
                    cards=self._cards(placed, at, levels[number][0]),
                    lost={self._rig.mesh_names[mesh]: len(points) for mesh, points in gone.items()},
                )
            )
        return measured

    def _off(
        self, places: Sequence[_Places], changed: IntArray, away: FloatArray, aways: Sequence[FloatArray]
    ) -> Iterator[tuple[IntArray, FloatArray]]:
        """Of each level, the points (k,) that have places and move, and how many mm (k,) they are off these.

        :param changed: (c,) points, some of which may move; others don't
        :param away: (3, c) how far these move, and of each level of `aways` at their places there
        """
        moving, moved = np.zeros((3, len(self._rest))), np.zeros(len(self._rest), bool)
        moving[:, changed], moved[changed] = away, _lengths(away) * self._mm >= _MOVED
        for placed, at_level in zip(places, aways, strict=True):
            level = moving
            if at_level is not away:
                level = np.zeros_like(moving)
                level[:, changed] = at_level
            own = np.flatnonzero(moved[placed.rows])
            rows = placed.rows[own]
            off = placed.off.take(own, axis=1) + moving.take(rows, axis=1)
            for corner, share in zip(placed.corners, placed.shares, strict=True):
                off -= share[own] * level.take(corner[own], axis=1)
            yield rows, _lengths(off) * self._mm

    def _cards(self, places: _Places, at: FloatArray, level: IntArray) -> dict[str, Distances]:
        """How far the points of cards that are gone are from those that stay, at their places `at` (n, 3)."""
        gone = self._by_mesh(np.setdiff1d(np.flatnonzero(self._card), places.rows))
        distances = dict[str, Distances]()
        of_level = self._mesh(level[:, 0])
        for number, points in gone.items():
            left = closest_places(self._rest[points], at, level[of_level == number])
            distances[self._rig.mesh_names[number]] = _distances(left.distances * self._mm)
        return distances

    def _mesh(self, points: IntArray) -> IntArray:
        return np.asarray(np.searchsorted(self._rig.mesh_offsets, points, side="right") - 1)

    def _by_mesh(self, points: IntArray) -> dict[int, IntArray]:
        number = self._mesh(points)
        return {int(one): points[number == one] for one in np.unique(number)}


def _lengths(vectors: FloatArray) -> FloatArray:
    """(n,) of vectors (3, n)."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=0)))


def _distances(mm: FloatArray) -> Distances:
    if not len(mm):
        return Distances(points=0, mean_mm=0.0, p95_mm=0.0, max_mm=0.0)
    # as `np.percentile`, which takes longer to find out what it is given than to sort that
    at = 0.95 * (len(mm) - 1)
    low, high = int(at), min(int(at) + 1, len(mm) - 1)
    ordered = np.partition(mm, (low, high))
    p95 = float(ordered[low] + (at - low) * (ordered[high] - ordered[low]))
    return Distances(points=len(mm), mean_mm=float(mm.mean()), p95_mm=p95, max_mm=float(mm.max()))


def _places(points: FloatArray, at: FloatArray, graph: Any, level: IntArray, used: IntArray) -> _Places:
    """Places of `used` points (n, 3) on a level whose points are at `at` (n, 3)."""
    count = len(points)
    nearest = nearest_sources(graph, np.unique(level))
    ones = np.ones(level.size, np.int32)
    corners = sparse.csr_array((ones, (level.ravel(), np.repeat(np.arange(len(level)), 3))), shape=(count, len(level)))
    around = sparse.csr_array(corners @ corners.T @ corners)  # point -> triangles of its triangles' points
    owners = used[nearest[used] >= 0]
    pairs = sparse.coo_array(around[nearest[owners]])
    places = closest_among(points[owners], at, level, pairs.row.astype(np.int64), pairs.col.astype(np.int64))
    shares = place_shares(places, at, level)
    off = points[owners] - np.einsum("rc,rci->ri", shares, at[level[places.triangles]])
    return _Places(owners, level[places.triangles].T.copy(), shares.T.copy(), off.T.copy())


_SHARES = (0.4, 0.15, 0.05)  # of the face's triangles, where no numbers are given
_MISSED = 1.05  # a level may have this many times the triangles that were asked for


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

    def as_text(self, out: Path) -> str:
        """The levels as a table."""
        rows: list[list[object]] = [
            ["level", "triangles", "of skin", "points", "mm off at rest", "shapes", "on the skin", "joints"]
        ]
        for level in self.levels:
            errors = level.errors
            rest, *moved = ({"rest": errors.rest}, errors.shapes, errors.skin_shapes, errors.joints)
            counts = (f"{count:,}" for count in (level.triangles, level.skin_triangles, level.points))
            rows.append([level.name, *counts, _worst(rest).partition(" (")[0], *map(_worst, moved)])
        lines = [
            f"{out}: {self.triangles:,} triangles; its levels:",
            table(rows),
            "mean / 95 % of the points, worst first",
        ]
        for level in self.levels:
            for mesh, gone in level.errors.cards.items():
                away = f"{gone.mean_mm:.2f} / {gone.p95_mm:.2f} mm from those that stay"
                lines.append(
                    f"{level.name}: points of cards of {mesh} that are left out (not in the errors above): {away}"
                )
        return "\n".join(lines)


def make_levels(face: Face, counts: Sequence[int], skin_share: float, watch: Watch) -> LodReport:
    """Author levels of at most `counts` triangles on a face over an override layer; none: some that suit it.

    :raises InputError: levels already there, no triangles, or counts that do not fall from the face's
    """
    if face.levels:
        raise InputError(face.where, "has levels of detail, expected a face without (or --edit, to make them anew)")
    if not any(len(mesh.face_vertex_counts) for mesh in face.meshes):
        raise InputError(face.where, "no triangles, expected a surface")
    face = face.with_identity()
    # with the texture coordinates of the prims: the materials, which stay, move them as they do those of the face
    surface = Surface(replace(face.parts(), meshes=face.meshes), face.rig())
    total = len(surface.triangles)
    counts = list(counts or [round(share * total) for share in _SHARES])
    for above, count in zip([total, *counts], counts, strict=False):
        if not 0 < count < above:
            expected = f"expected fewer than {above:,}, what is above it has" if count > 0 else "expected some"
            raise InputError(f"{face.where} -> level of {count:,} triangles", expected)
    full = FullFace(face.rig(), surface.triangles, surface.is_skin, surface.cards >= 0, face.mm_per_unit)
    rows = [surface.full]
    with watch("levels", len(counts) + full.poses) as bar:
        for count in counts:
            rows.append(surface.level(count, skin_share, rows[-1]))
            bar.update()
        # of all levels together: the full face is posed once a shape and joint, not once a level too
        places = [surface.places(row) for row in rows[1:]]
        errors = full.errors(list(zip(map(surface.points_of, rows[1:]), places, strict=True)), bar.update)
    made = [surface.meshes(*level) for level in zip(rows[1:], places, strict=True)]
    author_levels(face, made)
    levels, warnings = [], []
    for number, (count, row, meshes, error) in enumerate(zip(counts, rows[1:], made, errors, strict=True), 1):
        name, triangles = f"lod{number}", {mesh.name: len(mesh.face_vertex_counts) for mesh in meshes}
        level = Level(
            name=name,
            triangles=sum(triangles.values()),
            skin_triangles=surface.skin_triangles(row),
            points=sum(len(mesh.points) for mesh in meshes),
            meshes=triangles,
            errors=error,
        )
        levels.append(level)
        if level.triangles > _MISSED * count:
            what = f"{level.triangles:,} triangles, {count:,} can't be reached: seams and borders stay"
            warnings.append(f"{name}: {what}")
        if error.lost:
            gone = ", ".join(f"{mesh} ({points:,})" for mesh, points in error.lost.items())
            warnings.append(f"{name}: some pieces have no triangle left, and no error counts them (points): {gone}")
    return LodReport(triangles=total, levels=tuple(levels), warnings=tuple(warnings))


def _worst(distances: Mapping[str, Distances]) -> str:
    """The largest mean and 95th percentile, and whose they are."""
    if not distances:
        return "-"
    names = [max(distances, key=lambda name: getattr(distances[name], key)) for key in ("mean_mm", "p95_mm")]
    mean, p95 = distances[names[0]].mean_mm, distances[names[1]].p95_mm
    return f"{mean:.2f} / {p95:.2f} ({', '.join(dict.fromkeys(name.rpartition('/')[2] for name in names))})"
