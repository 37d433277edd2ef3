"""Triangles that a blend turns over though no source does, and what turns them back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.local_push import Demands
from facepipe.geometry.polygons import touching, triangle_normals, turned_triangles

_AREA = 0.02  # of the nearest source's area: what a triangle that is turned back has
_RINGS = 2  # of triangles around those turned over that are to stay as they face


class Folds:
    """Those of some triangles that face away from all sources' in the same pose: what one of these folds may stay so.

    :param pose: (n, 3) of the blend, which may change between looks
    :param sources: (n, 3) each
    :param triangles: (t, 3)
    """

    def __init__(self, pose: FloatArray, sources: Sequence[FloatArray], triangles: IntArray) -> None:
        self._pose, self._sources, self._triangles = pose, sources, triangles
        self._first = _crossed(sources[0], triangles)
        self.turned: IntArray = np.zeros(0, np.int64)  # into the triangles
        self._demands, self._own = Demands(triangles[:0], np.zeros((0, 3, 3)), np.zeros(0)), np.zeros(0, bool)

    def look(self) -> None:
        """Find them."""
        # few face away from the first source's: only those have their areas and the other sources looked at
        along = np.einsum("it,it->t", self._first, _crossed(self._pose, self._triangles))
        self.turned = np.flatnonzero(along < 0)
        for points in self._sources:
            triangles = self._triangles[self.turned]
            self.turned = self.turned[turned_triangles(triangle_normals(points, triangles), self._pose, triangles)]
        watched = self._around()
        self._demands, self._own = self._facing(watched), np.isin(watched, self.turned)

    @property
    def cost(self) -> float:
        """The sum of squares of how far they are from facing the other way."""
        return float((self._demands.needs[self._own] ** 2).sum())

    def demands(self) -> Demands:
        """That they turn back, and that those around them stay as they face."""
        return self._demands

    def _around(self) -> IntArray:
        """(w,) those turned over and two rings around them.

        Creases at corners of mouths have triangles of 0.01 mm2 whose normals differ by 90 degrees and more from source
        to source. With demands of turned ones alone each push turned another one of them over, and 8 of skin stayed so
        in 30 blends of 142 shapes; with one ring around them one did.
        """
        around, near = self.turned, np.zeros(len(self._pose), bool)
        for _ in range(_RINGS if len(around) else 0):
            near[self._triangles[around]] = True
            around = np.flatnonzero(touching(self._triangles, near))
        return around

    def _facing(self, watched: IntArray) -> Demands:
        """That triangles `watched` (w,) face as the source does that is nearest to how they face.

        The signed area ``n . ((b - a) x (c - a)) / 2`` against a source's normal n is to be above 0; with one corner it
        changes by ``n x (c - b) / 2``, taken as a distance: over the root of the squares of all three.
        """
        triangles, rows = self._triangles[watched], np.arange(len(watched))
        corners, own = self._pose[triangles], triangle_normals(self._pose, triangles)
        normals = np.stack([triangle_normals(points, triangles) for points in self._sources])
        nearest = np.einsum("kti,ti->kt", normals, own).argmax(axis=0)
        towards = normals[nearest, rows]
        areas = np.stack([np.linalg.norm(_crossed(points, triangles), axis=0) for points in self._sources])
        ways = np.cross(towards[:, None], corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]])
        size = np.linalg.norm(ways, axis=(1, 2))
        size[size <= 0] = 1.0
        needs = _AREA * areas[nearest, rows] - np.einsum("ti,it->t", towards, _crossed(self._pose, triangles))
        return Demands(triangles, ways / size[:, None, None], needs / size)


def _crossed(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(3, t) normals of triangles (t, 3), twice as long as their areas: by columns, a fifth of the time of np.cross."""
    columns = np.ascontiguousarray(points.T)
    a, b, c = (columns.take(corner, axis=1) for corner in triangles.T)
    (x, y, z), (u, v, w) = b - a, c - a
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])
