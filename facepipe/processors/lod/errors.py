"""How far a level is from the full face: at rest, in every shape, and with every joint turned."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.closest_points import closest_among, place_shares
from facepipe.geometry.geodesics import nearest_sources, surface_graph
from facepipe.rig import Rig

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
    lost: Mapping[str, int]  # mesh -> points of its connected pieces that the level has no triangle of


class _Places(NamedTuple):
    """Where the points of the full face are on a level."""

    shares: Any  # (n, n) of the points of the level
    found: BoolArray  # (n,) points that have a place


class FullFace:
    """The points of a full face, posed, to measure its levels against."""

    def __init__(self, rig: Rig, triangles: IntArray, is_skin: BoolArray, mm_per_unit: float) -> None:
        """:param triangles: (t, 3) of the points of all meshes; `is_skin` (t,) of them"""
        self._rig, self._mm = rig, mm_per_unit
        self._rest = rig.evaluate()
        self._used = np.unique(triangles)
        self._skin = np.isin(np.arange(len(self._rest)), triangles[is_skin])
        self._graph = surface_graph(self._rest, np.pad(triangles, ((0, 0), (0, 1)), constant_values=-1))

    @property
    def poses(self) -> int:
        """How many there are to measure in."""
        return len(self._rig.shapes) + len(self._rig.joints)

    def errors(self, levels: Sequence[IntArray], step: Callable[[], object]) -> list[LevelErrors]:
        """Of levels, each triangles (t, 3) of points of the face.

        A point's place is the nearest one on the triangles about the point of the level that is nearest to it along
        the surface, so that it is on its own lip, lid and part; the place then moves with the corners of its triangle.

        :param step: called after every pose
        """
        places = [_places(self._rest, self._graph, triangles, self._used) for triangles in levels]
        shapes, skin, joints = ([dict[str, Distances]() for _ in levels] for _ in range(3))
        for name in self._rig.shapes:
            posed = self._rig.evaluate({name: 1.0})
            moved = self._moves(posed)
            for number, one in enumerate(places):
                shapes[number][name] = self._off(one, posed, moved)
                skin[number][name] = self._off(one, posed, moved & self._skin)
            step()
        for name, posed in self._turned():
            for number, one in enumerate(places):
                joints[number][name] = self._off(one, posed, self._moves(posed))
            step()
        rest = [self._off(one, self._rest, one.found) for one in places]
        each = zip(rest, shapes, skin, joints, map(self._lost, places), strict=True)
        return [LevelErrors(rest=a, shapes=b, skin_shapes=c, joints=d, lost=e) for a, b, c, d, e in each]

    def _turned(self) -> Iterator[tuple[str, FloatArray]]:
        for number, joint in enumerate(self._rig.joints):
            coefficients = np.tile([0.0] * 6 + [1.0] * 3, (len(self._rig.joints), 1))
            coefficients[number, 3] = _TURN
            yield joint, self._rig.evaluate(coefficients=coefficients)

    def _moves(self, posed: FloatArray) -> BoolArray:
        return np.asarray(np.linalg.norm(posed - self._rest, axis=1) * self._mm >= _MOVED)

    def _off(self, places: _Places, posed: FloatArray, among: BoolArray) -> Distances:
        rows = np.flatnonzero(among & places.found)
        off = np.linalg.norm(posed[rows] - places.shares[rows] @ posed, axis=1) * self._mm
        if not len(off):
            return Distances(points=0, mean_mm=0.0, p95_mm=0.0, max_mm=0.0)
        p95 = float(np.percentile(off, 95))
        return Distances(points=len(off), mean_mm=float(off.mean()), p95_mm=p95, max_mm=float(off.max()))

    def _lost(self, places: _Places) -> dict[str, int]:
        away = np.setdiff1d(self._used, np.flatnonzero(places.found))
        number = np.searchsorted(self._rig.mesh_offsets, away, side="right") - 1
        counts = np.bincount(number, minlength=len(self._rig.mesh_names))
        return {name: int(count) for name, count in zip(self._rig.mesh_names, counts, strict=True) if count}


def _places(points: FloatArray, graph: Any, level: IntArray, used: IntArray) -> _Places:
    count = len(points)
    nearest = nearest_sources(graph, np.unique(level))
    ones = np.ones(level.size, np.int32)
    corners = sparse.csr_array((ones, (level.ravel(), np.repeat(np.arange(len(level)), 3))), shape=(count, len(level)))
    around = sparse.csr_array(corners @ corners.T @ corners)  # point -> triangles of its triangles' points
    owners = used[nearest[used] >= 0]
    rows = sparse.coo_array(around[nearest[owners]])
    places = closest_among(points[owners], points, level, rows.row.astype(np.int64), rows.col.astype(np.int64))
    entries = (np.repeat(owners, 3), level[places.triangles].ravel())
    shares = sparse.csr_array((place_shares(places, points, level).ravel(), entries), shape=(count, count))
    return _Places(shares, np.isin(np.arange(count), owners))
