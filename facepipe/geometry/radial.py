"""Surfaces about a centre, told by their radius in every direction: eyeballs with their corneas."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_MIXED = 3  # points nearest in direction
_NEAREST = 1e-6  # angles below this count as this: at a point itself its own radius is all that counts


class RadialSurface:
    """A surface that every ray from its centre crosses once.

    Its radius in a direction is mixed of those of its points that are nearest in direction, the nearer the more. So a
    ball is exact however coarse its mesh is, and a surface that ends (the front half of an eye) goes on as a ball.

    :param points: (n, 3) of the surface, n at least 1
    :param centre: (3,)
    """

    def __init__(self, points: FloatArray, centre: FloatArray) -> None:
        from scipy.spatial import cKDTree

        self.centre = np.asarray(centre, np.float64)
        directions, self._radii = self._polar(points)
        self.largest = float(self._radii.max())
        self._tree = cKDTree(directions)

    def depths(self, points: FloatArray) -> FloatArray:
        """(m,) how far `points` (m, 3) lie inside, along the ray from the centre; 0 outside."""
        directions, distances = self._polar(points)
        near = np.flatnonzero(distances < self.largest)
        angles, which = self._tree.query(directions[near], k=np.arange(1, min(_MIXED, len(self._radii)) + 1))
        weights = 1.0 / np.maximum(angles, _NEAREST) ** 2
        radii = (weights * self._radii[which]).sum(axis=1) / weights.sum(axis=1)
        depths = np.zeros(len(distances))
        depths[near] = np.maximum(radii - distances[near], 0.0)
        return depths

    def _polar(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        offsets = np.asarray(points, np.float64) - self.centre
        lengths = np.sqrt(np.einsum("mi,mi->m", offsets, offsets))
        return offsets / np.where(lengths > 0, lengths, 1.0)[:, None], lengths
