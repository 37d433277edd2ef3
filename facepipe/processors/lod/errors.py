"""How far a level is from the full face: at rest, in every shape, and with every joint turned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from facepipe.core.arrays import FloatArray, IntArray
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
    joints: Mapping[str, Distances]
    lost: int  # points of parts that the level has no triangle of


class FullFace:
    """The points of a full face, posed, to measure its levels against."""

    def __init__(self, rig: Rig, triangles: IntArray, mm_per_unit: float) -> None:
        """:param triangles: (t, 3) of the points of all meshes"""
        self._rig, self._mm = rig, mm_per_unit
        self._rest = rig.evaluate()
        self._used = np.unique(triangles)
        self._graph = surface_graph(self._rest, np.pad(triangles, ((0, 0), (0, 1)), constant_values=-1))

    def errors(self, triangles: IntArray) -> LevelErrors:
        """Of a level, triangles (t, 3) of points of the face.

        A point's place is the nearest one on the triangles about the point of the level that is nearest to it along
        the surface, so that it is on its own lip, lid and part; the place then moves with the corners of its triangle.
        """
        places, found = _places(self._rest, self._graph, triangles, self._used)
        rest = self._off(places, found, self._rest)
        shapes, joints = {}, {}
        for name in self._rig.shapes:
            shapes[name] = self._moved(places, found, self._rig.evaluate({name: 1.0}))
        for name, posed in self._turned():
            joints[name] = self._moved(places, found, posed)
        return LevelErrors(rest=_distances(rest), shapes=shapes, joints=joints, lost=len(self._used) - int(found.sum()))

    def _turned(self) -> Iterator[tuple[str, FloatArray]]:
        for number, joint in enumerate(self._rig.joints):
            coefficients = np.tile([0.0] * 6 + [1.0] * 3, (len(self._rig.joints), 1))
            coefficients[number, 3] = _TURN
            yield joint, self._rig.evaluate(coefficients=coefficients)

    def _moved(self, places: Any, found: FloatArray, posed: FloatArray) -> Distances:
        moved = np.linalg.norm(posed - self._rest, axis=1)[found] * self._mm >= _MOVED
        return _distances(self._off(places, found, posed)[moved])

    def _off(self, places: Any, found: FloatArray, posed: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(posed - places @ posed, axis=1)[found] * self._mm)


def _places(points: FloatArray, graph: Any, level: IntArray, used: IntArray) -> tuple[Any, Any]:
    """(n, n) shares of the points of a level in the place of each point, and (n,) which have one."""
    count = len(points)
    nearest = nearest_sources(graph, np.unique(level))
    ones = np.ones(level.size, np.int32)
    corners = sparse.csr_array((ones, (level.ravel(), np.repeat(np.arange(len(level)), 3))), shape=(count, len(level)))
    around = sparse.csr_array(corners @ corners.T @ corners)  # point -> triangles of its triangles' points
    owners = used[nearest[used] >= 0]
    rows = sparse.coo_array(around[nearest[owners]])
    places = closest_among(points[owners], points, level, rows.row.astype(np.int64), rows.col.astype(np.int64))
    shares = place_shares(places, points, level)
    entries = (np.repeat(owners, 3), level[places.triangles].ravel())
    found = np.zeros(count, bool)
    found[owners] = True
    return sparse.csr_array((shares.ravel(), entries), shape=(count, count)), found


def _distances(values: FloatArray) -> Distances:
    if not len(values):
        return Distances(points=0, mean_mm=0.0, p95_mm=0.0, max_mm=0.0)
    p95 = float(np.percentile(values, 95))
    return Distances(points=len(values), mean_mm=float(values.mean()), p95_mm=p95, max_mm=float(values.max()))
