"""What a surface that moves in part asks of it: neighbouring triangles change alike, and no more than they need to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.block_system import BlockSystem, Groups, pairs_within
from facepipe.geometry.triangle_changes import Neighbours, TriangleChanges


@dataclass(frozen=True, kw_only=True)
class ChangeSmoothness:
    """``smooth * sum |T_i - T_j|^2 + near * sum area |T_i - 1|^2``, the sums as integrals over the surface.

    Triangles beside those that move count too, so that a part goes over into what stays without a crease.
    """

    changes: TriangleChanges  # of triangles that move
    neighbours: Neighbours
    free: IntArray  # (f,) points that move, ascending
    links: IntArray  # (p,) ascending ``lower * f + higher`` of pairs of those that have terms in common
    smooth: float
    near: float
    _pairs: Groups
    _single: Groups

    @classmethod
    def of(
        cls, points: FloatArray, triangles: IntArray, free: BoolArray, smooth: float, near: float
    ) -> ChangeSmoothness:
        """Of a surface at rest.

        :param points: (n, 3) and `free` (n,), those that move
        """
        number = np.where(free, np.cumsum(free) - 1, -1)
        touched = free[triangles].any(axis=1)
        beside = np.zeros(len(points), bool)
        beside[triangles[touched]] = True
        changes = TriangleChanges.of(points, triangles[beside[triangles].any(axis=1)])
        neighbours = Neighbours.of(points, changes.triangles, changes.areas).where(free)
        quads, corners = number[neighbours.points], number[changes.triangles]
        count = int(np.count_nonzero(free))
        low, high = np.sort(np.concatenate([pairs_within(quads), pairs_within(corners)]), axis=1).T
        linked = np.unique((low * count + high)[low < high])
        return cls(
            changes=changes,
            neighbours=neighbours,
            free=np.flatnonzero(free),
            links=linked,
            smooth=smooth,
            near=near,
            _pairs=Groups.of(quads, count, linked),
            _single=Groups.of(corners, count, linked),
        )

    def system(self, points: FloatArray) -> BlockSystem:
        """Normal equations for moves of the free points from where all `points` (n, 3) are now."""
        found = BlockSystem(len(self.free), self.links)
        changes, derivative = self.changes.at(points), self.changes.derivative(points)
        differences = self.neighbours.differences(changes)
        slopes = self.neighbours.derivative(derivative)
        found.add(self._pairs, slopes, differences, self.smooth * self.neighbours.weights)
        own = (changes - np.eye(3)).reshape(-1, 9)
        found.add(self._single, derivative, own, self.near * self.changes.areas)
        return found
