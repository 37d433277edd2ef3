"""Whether places lie inside a surface that may be open, folded or run through itself: its winding numbers there."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.vectors import cross_columns, dot_columns

_FAR = 3.0  # radii of a triangle from which on its area alone counts: off by less than 0.01 in all for a head's skin
_AT_ONCE = 16  # places: with all triangles of a mouth, what they take fits into a cache; 8 take a twentieth longer


class WindingNumbers:
    """How often a surface goes around a place: 1 inside, 0 outside, 2 where it laps over itself.

    The sum of the solid angles of all triangles, over 4 pi: van Oosterom and Strackee, The solid angle of a plane
    triangle, 1983; far triangles as dipoles: Barill et al., Fast winding numbers for soups and clouds, 2018.
    """

    def __init__(self, points: FloatArray, triangles: IntArray) -> None:
        """Of `points` (n, 3) and `triangles` (t, 3)."""
        columns = np.ascontiguousarray(points.T)  # a coordinate a row: a tenth of the time of rows of points
        self._corners = a, b, c = [columns.take(corner, axis=1) for corner in triangles.T]
        middles, areas = (a + b + c) / 3.0, 0.5 * cross_columns(b - a, c - a)
        reach2 = np.zeros(len(triangles))
        for corner in self._corners:
            away = corner - middles
            np.maximum(reach2, _FAR**2 * dot_columns(away, away), out=reach2)
        # Far triangles in float32 around their middle, which takes half as long: that they are taken as dipoles is off
        # by a thousand times as much.
        self._origin = middles.mean(axis=1) if len(triangles) else np.zeros(3)
        middles -= self._origin[:, None]
        parts = -2.0 * middles, areas, dot_columns(middles, middles), dot_columns(middles, areas), reach2
        self._doubled, self._areas, self._squares, self._products, self._reach2 = (
            part.astype(np.float32) for part in parts
        )

    def at(self, places: FloatArray) -> FloatArray:
        """(m,) of `places` (m, 3). An open surface counts as the share of the sphere around that it covers."""
        parts = [self._at(places[first : first + _AT_ONCE]) for first in range(0, len(places), _AT_ONCE)]
        return np.concatenate([np.zeros(0), *parts])

    def _at(self, places: FloatArray) -> FloatArray:
        # |m - p|^2 and (m - p) . a by products of matrices: half the passes over all triangles that differences take
        local = (places - self._origin).astype(np.float32)
        distances2 = local @ self._doubled
        distances2 += self._squares
        distances2 += (local * local).sum(axis=1)[:, None]
        dipoles = self._products - local @ self._areas
        rows, near = np.divmod(np.flatnonzero(distances2 < self._reach2), len(self._reach2))
        distances2[rows, near] = np.inf  # these are taken exactly
        dipoles /= distances2
        dipoles /= np.sqrt(distances2, out=distances2)
        a, b, c = (corner.take(near, axis=1) - places[rows].T for corner in self._corners)
        la, lb, lc = (np.sqrt(dot_columns(corner, corner)) for corner in (a, b, c))
        beside = la * lb * lc + dot_columns(a, b) * lc + dot_columns(b, c) * la + dot_columns(c, a) * lb
        angles = 2.0 * np.arctan2(dot_columns(a, cross_columns(b, c)), beside)
        whole = dipoles.sum(axis=1) + np.bincount(rows, angles, minlength=len(places))
        return np.asarray(whole / (4.0 * np.pi))
