"""Triangles that a blend turns over though no source does, and what turns them back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.local_push import Demands
from facepipe.geometry.polygons import triangle_normals

_AREA = 0.02  # of the nearest source's area: what a triangle that is turned back has


class Folds:
    """Those of some triangles that face away from all sources' in the same pose: what one of these folds may stay so.

    :param pose: (n, 3) of the blend, which may change between looks
    :param sources: (n, 3) each
    :param triangles: (t, 3)
    """

    def __init__(self, pose: FloatArray, sources: Sequence[FloatArray], triangles: IntArray) -> None:
        self._pose, self._sources, self._triangles = pose, sources, triangles
        self._normals = [triangle_normals(points, triangles) for points in sources]
        self.turned: IntArray = np.zeros(0, np.int64)  # into the triangles
        self._demands = Demands(triangles[:0], np.zeros((0, 3, 3)), np.zeros(0))

    def look(self) -> None:
        """Find them."""
        own = triangle_normals(self._pose, self._triangles)
        left = np.ones(len(own), bool)
        for normals in self._normals:
            left &= np.einsum("ti,ti->t", normals, own) < 0
        self.turned = np.flatnonzero(left)
        self._demands = self._turned_back(own[self.turned])

    @property
    def cost(self) -> float:
        """The sum of squares of how far they are from facing the other way."""
        return float((self._demands.needs**2).sum())

    def demands(self) -> Demands:
        """That they turn back."""
        return self._demands

    def _turned_back(self, own: FloatArray) -> Demands:
        """To the normals of the source that is nearest to `own` (f, 3).

        The signed area ``n . ((b - a) x (c - a)) / 2`` against a source's normal n is to be above 0; with one corner it
        changes by ``n x (c - b) / 2``, taken as a distance: over the root of the squares of all three.
        """
        triangles, rows = self._triangles[self.turned], np.arange(len(self.turned))
        corners, normals = self._pose[triangles], np.stack([one[self.turned] for one in self._normals])
        nearest = np.einsum("kti,ti->kt", normals, own).argmax(axis=0)
        towards = normals[nearest, rows]
        areas = np.stack([np.linalg.norm(_crossed(points[triangles]), axis=1) for points in self._sources])
        ways = np.cross(towards[:, None], corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]])
        size = np.linalg.norm(ways, axis=(1, 2))
        size[size <= 0] = 1.0
        needs = _AREA * areas[nearest, rows] - np.einsum("ti,ti->t", towards, _crossed(corners))
        return Demands(triangles, ways / size[:, None, None], needs / size)


def _crossed(corners: FloatArray) -> FloatArray:
    """(t, 3) normals of triangles with corners (t, 3, 3), twice as long as their areas."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
