"""Points beside a surface that go with the points of it that they are nearest to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray

_NEAR = 3


@dataclass(frozen=True, kw_only=True)
class NearbyPoints:
    """m points, and what each takes of the surface's."""

    rows: IntArray  # (m, k) of the surface
    shares: FloatArray  # (m, k), in sum 1

    @classmethod
    def of(cls, points: FloatArray, surface: FloatArray, least: float) -> NearbyPoints:
        """Points (m, 3) by inverse distance to those of a surface (n, 3).

        :param least: what distances are longer than they are: a point on one of the surface's would divide by 0
        """
        each = range(1, min(_NEAR, len(surface)) + 1)
        apart, near = cKDTree(surface).query(points, k=list(each))
        shares = 1 / (apart + least)
        return cls(rows=near, shares=shares / shares.sum(axis=1, keepdims=True))

    def carried(self, moves: FloatArray) -> FloatArray:
        """(..., m, 3) moves of the points where the surface's are (..., n, 3)."""
        return np.asarray(np.einsum("mk,...mkc->...mc", self.shares, moves[..., self.rows, :]))
