"""What a surface that moves in part asks of it: neighbouring triangles change alike, and no more than they need to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.block_system import BlockSystem, Groups, pairs_within
from facepipe.geometry.elimination import Elimination
from facepipe.geometry.point_factor import PointFactor
from facepipe.geometry.triangle_changes import Neighbours, TriangleChanges


@dataclass(frozen=True, kw_only=True)
class ChangeSmoothness:
    """``smooth * sum |T_i - T_j|^2 + near * sum area |T_i - 1|^2``, the sums as integrals over the surface.

    Triangles beside those that move count too, so that a part goes over into what stays without a crease.
    """

    changes: TriangleChanges  # of triangles that move
    neighbours: Neighbours
    free: IntArray  # (f,) points that move, ascending
    elimination: Elimination  # of those
    smooth: float
    near: float
    _pairs: Groups
    _single: Groups

    @classmethod
    def of(
        cls, points: FloatArray, triangles: IntArray, free: BoolArray, smooth: float, near: float, links: IntArray
    ) -> ChangeSmoothness:
        """Of a surface at rest.

        :param points: (n, 3) and `free` (n,), those that move
        :param links: (p, 2) pairs of points that will have other terms in common
        """
        number = np.where(free, np.cumsum(free) - 1, -1)
        touched = free[triangles].any(axis=1)
        beside = np.zeros(len(points), bool)
        beside[triangles[touched]] = True
        changes = TriangleChanges.of(points, triangles[beside[triangles].any(axis=1)])
        neighbours = Neighbours.of(points, changes.triangles, changes.areas).where(free)
        quads, corners = number[neighbours.points], number[changes.triangles]
        linked = np.concatenate([pairs_within(quads), pairs_within(corners), pairs_within(number[links])])
        elimination = Elimination.of(points[free], linked)
        count = len(elimination.order)
        return cls(
            changes=changes,
            neighbours=neighbours,
            free=np.flatnonzero(free),
            elimination=elimination,
            smooth=smooth,
            near=near,
            _pairs=Groups.of(quads, count, elimination.links),
            _single=Groups.of(corners, count, elimination.links),
        )

    def system(self, points: FloatArray) -> BlockSystem:
        """Normal equations for moves of the free points from where all `points` (n, 3) are now."""
        found = BlockSystem(len(self.free), len(self.elimination.links))
        changes, derivative = self.changes.at(points), self.changes.derivative(points)
        differences = self.neighbours.differences(changes)
        slopes = self.neighbours.derivative(derivative)
        found.add(self._pairs, slopes, differences, self.smooth * self.neighbours.weights)
        own = (changes - np.eye(3)).reshape(-1, 9)
        found.add(self._single, derivative, own, self.near * self.changes.areas)
        return found

    def factor(self, system: BlockSystem, shared: Any) -> PointFactor:
        """Of a system with more on top: `shared` (f, f) sparse, the same for each axis."""
        return PointFactor(self.elimination, shared, system.own, system.between)
