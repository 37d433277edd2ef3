"""A scan to fit to: the nearest places that can correspond to points of the face."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.closest_points import SurfaceSearch, place_shares
from facepipe.geometry.polygons import edges, point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.vectors import unit_vectors

_SMOOTHINGS = 2  # noise of 0.1 mm turns the triangles of a scan by several degrees
_ON_EDGE = 1e-9
_AS_IT_LIES = Similarity(rotation=np.eye(3), translation=np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Counterparts of the face's points on the scan."""

    places: FloatArray  # (m, 3)
    normals: FloatArray  # (m, 3) of the scan there
    distances: FloatArray  # (m,) from the surface: of a cloud, from the plane through the nearest point
    kept: BoolArray  # (m,)


@dataclass(frozen=True, kw_only=True)
class ScanTarget:
    """A surface, or a cloud of points with normals."""

    points: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3); none in a cloud
    normals: FloatArray  # (n, 3) unit
    border: BoolArray  # (n,) points where the scan ends

    @classmethod
    def of_surface(cls, points: FloatArray, triangles: IntArray) -> ScanTarget:
        """A triangulated scan, oriented outward; its normals are smoothed."""
        points = np.asarray(points, np.float64)
        pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
        border = np.zeros(len(points), bool)
        border[pairs[uses == 1].ravel()] = True
        normals = _smoothed(point_normals(points, triangles), pairs)
        return cls(points=points, triangles=triangles, normals=normals, border=border)

    @classmethod
    def of_cloud(cls, points: FloatArray, normals: FloatArray) -> ScanTarget:
        """A cloud with outward normals (n, 3); where it ends is not known."""
        nothing = np.zeros((0, 3), np.int64)
        return cls(
            points=np.asarray(points, np.float64),
            triangles=nothing,
            normals=np.asarray(normals, np.float64),
            border=np.zeros(len(points), bool),
        )

    def moved(self, by: Similarity) -> ScanTarget:
        """The same scan elsewhere."""
        return replace(self, points=by.apply(self.points), normals=self.normals @ by.rotation.T)

    def matches(
        self,
        points: FloatArray,
        normals: FloatArray,
        reach: float,
        angle: float,
        place: Similarity = _AS_IT_LIES,
        *,
        roughly: bool = False,
    ) -> Matches:
        """The nearest places to points (m, 3) with unit normals (m, 3).

        Kept are those up to `reach` away, whose normals differ by up to `angle` radians, and that are not on the
        scan's border: there the face goes on and the scan does not.

        :param place: from the scan to where the points are; what is found is there too. The scan itself stays, so that
            it is sorted once for all searches
        :param roughly: the nearest points of the scan instead of places on its triangles, in a tenth of the time
        """
        near, facing, distances, ended = self._nearest(place.undo(points), roughly or not len(self.triangles))
        places, facing, distances = (
            place.apply(near),
            facing @ place.rotation.T,
            place.scale * distances,
        )
        alike = np.einsum("mi,mi->m", facing, normals) >= np.cos(angle)
        kept = alike & ~ended & (distances <= reach)
        if not len(self.triangles):  # gaps between points of a cloud are no distance from what they show
            distances = np.abs(np.einsum("mi,mi->m", points - places, facing))
        return Matches(places=places, normals=facing, distances=distances, kept=kept)

    def _nearest(self, points: FloatArray, of_points: bool) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        if of_points:
            distances, number = self._tree.query(points)
            return self.points[number], self.normals[number], distances, self.border[number]
        nearest = self._search.closest(points)
        shares = place_shares(nearest, self.points, self.triangles)
        corners = self.triangles[nearest.triangles]
        normals = unit_vectors(np.einsum("mc,mci->mi", shares, self.normals[corners]))
        ended = np.asarray(((shares > _ON_EDGE) & self.border[corners]).any(axis=1))
        return nearest.places, normals, nearest.distances, ended

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    @cached_property
    def _search(self) -> SurfaceSearch:
        return SurfaceSearch(self.points, self.triangles)


def _smoothed(normals: FloatArray, pairs: IntArray) -> FloatArray:
    from scipy.sparse import csr_array

    count = len(normals)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    neighbours = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    for _ in range(_SMOOTHINGS):
        normals = unit_vectors(normals + neighbours @ normals)
    return normals
