"""Texels of a texture that lie on a surface, and where each of them is on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.geometry.rasterise import barycentrics, interpolated, rasterise, screen_triangles


@dataclass(frozen=True, kw_only=True)
class Texels:
    """Texels whose centres a surface covers in its texture coordinates."""

    size: int  # texels a side of the texture
    at: IntArray  # (m,) row * size + column, top row first, ascending
    corners: IntArray  # (m, 3) points of the triangle that covers it
    weights: Float32Array  # (m, 3) barycentrics there

    def carried(self, values: FloatArray) -> Float32Array:
        """(m, c) values (n, c) of the surface's points, interpolated."""
        corners = (np.asarray(values, np.float32)[corner] for corner in self.corners.T)
        return np.asarray(interpolated(tuple(corners), self.weights), np.float32)

    def summed(self, values: FloatArray, count: int) -> FloatArray:
        """(count, c) sums over texels of values (m, c), shared out to points by barycentrics: `carried`, transposed."""
        sums = np.zeros((count, values.shape[1]))
        for corner, weight in zip(self.corners.T, self.weights.T, strict=True):
            for channel in range(values.shape[1]):
                sums[:, channel] += np.bincount(corner, weight * values[:, channel], minlength=count)
        return sums

    def taken(self, places: IntArray) -> Texels:
        """Those at `places`, in that order."""
        parts = {name: getattr(self, name)[places] for name in ("at", "corners", "weights")}
        return Texels(size=self.size, **parts)

    def picture(self, values: FloatArray, otherwise: FloatArray) -> FloatArray:
        """(size, size, c) values (m, c) at the texels, and `otherwise` (size, size, c) beside them."""
        filled = np.array(otherwise, np.float32).reshape(self.size**2, -1)
        filled[self.at] = values
        return filled.reshape(self.size, self.size, -1)


def texels_of(uv_corners: FloatArray, triangles: IntArray, size: int) -> Texels:
    """The texels that triangles cover; where several do, those of the first.

    :param uv_corners: (t, 3, 2) texture coordinates, v up, which repeat: a triangle lies in the unit square of its mean
    :param triangles: (t, 3) points
    """
    inside = uv_corners - np.floor(uv_corners.mean(axis=1, keepdims=True))
    flat = inside.reshape(-1, 2)
    screen = np.column_stack([flat[:, 0] * size, (1.0 - flat[:, 1]) * size, np.ones(len(flat)), np.ones(len(flat))])
    numbers = np.arange(len(flat)).reshape(-1, 3)
    raster = rasterise(screen_triangles(screen, numbers), size, size)
    row, column = np.nonzero(raster.key)
    ids = raster.triangle[row, column]
    weights = barycentrics(screen, numbers, ids, column + 0.5, row + 0.5)
    return Texels(size=size, at=row * size + column, corners=triangles[ids], weights=weights.astype(np.float32))
