"""The mesh of another head: its points, sewn at seams, and what connects them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.geodesics import surface_graph
from facepipe.geometry.polygons import components, edges, point_normals, welded_points

_SAME = 1e-6  # border points nearer than this share of the head's size are one


@dataclass(frozen=True, kw_only=True)
class HeadMesh:
    """The mesh of a head in millimetres, and what connects its points.

    Points that lie on one another at borders are sewn, so that seams of UVs cut nothing: each of `points` stands for
    all of them.
    """

    points: FloatArray  # (s, 3) sewn
    triangles: IntArray  # (t, 3) of these, each with three points
    group: IntArray  # (m,) sewn point of every point of the head

    @classmethod
    def of(cls, points: FloatArray, triangles: IntArray) -> HeadMesh:
        """Points (m, 3), millimetres, and triangles (t, 3).

        :raises InputError: no triangle
        """
        if not len(triangles):
            raise InputError("head", "no triangles, expected a surface to put shapes on")
        pairs, uses = edges(np.full(len(triangles), 3), triangles.ravel())
        border = np.zeros(len(points), bool)
        border[pairs[uses == 1].ravel()] = True
        group = welded_points(points, border, _SAME * float(np.ptp(points[triangles.ravel()], axis=0).max()))
        first = np.unique(group, return_index=True)[1]
        sewn = group[triangles]
        return cls(points=points[first], triangles=sewn[(sewn != sewn[:, [1, 2, 0]]).all(axis=1)], group=group)

    @cached_property
    def normals(self) -> FloatArray:
        """(s, 3)."""
        return point_normals(self.points, self.triangles)

    @cached_property
    def graph(self) -> Any:
        """(s, s) lengths along the surface."""
        return surface_graph(self.points, np.pad(self.triangles, ((0, 0), (0, 1)), constant_values=-1))

    @cached_property
    def component(self) -> IntArray:
        """(s,) number of the connected piece of each."""
        return components(len(self.points), np.concatenate([self.triangles[:, :2], self.triangles[:, 1:]]))
