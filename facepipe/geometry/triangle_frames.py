"""Frames of triangles with their normals, and gradients of what varies over a triangulated surface.

The frame of a triangle is two of its edges and the scaled normal ``e1 x e2 / sqrt(|e1 x e2|)``, which stands for the
fourth vertex of Sumner & Popović, "Deformation Transfer for Triangle Meshes", SIGGRAPH 2004, section 3.

The change of a triangle is the 3 x 3 matrix T that takes its frame from rest to where it is now: T is linear in the
frame, ``T = e1' d1^T + e2' d2^T + n' d3^T`` with the duals d of the frame at rest. Sumner & Popović give each triangle
a fourth vertex of its own. Here the normal follows from the corners, so that its column of T is taken to first order
about where the triangle is: that leaves a third of the unknowns, and no freedom to shear the surface against its normal
at no cost. T is the same all over where a surface is turned, scaled and moved as a whole; an affine map changes the
edges of all triangles alike, but not their normals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import components

_FLAT_HEIGHT = 1e-6  # a triangle lower than this share of its longest edge has no area and no normal


def frames(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3, 3) rows: two edges, and the normal as long as the square root of their cross product."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([b - a, c - a, normal / np.sqrt(np.maximum(length, np.finfo(np.float64).tiny))], axis=1)


def duals(triangle_frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows (t, 3, 3) with ``frame^T dual`` the identity, and areas (t,); both 0 for triangles without area.

    ``d1 = e2 x u / 2A, d2 = u x e1 / 2A, d3 = n / |n|^2`` with the unit normal u and ``2A = |e1 x e2| = |n|^2``: in
    closed form, which also shows the triangles that have no inverse.

    :param triangle_frames: (t, 3, 3) frames
    """
    first, second, normal = triangle_frames.transpose(1, 0, 2)
    doubled = (normal * normal).sum(axis=1)  # |n|^2 = |e1 x e2|
    longest = np.maximum.reduce([(side * side).sum(axis=1) for side in (first, second, second - first)])
    flat = doubled <= _FLAT_HEIGHT * longest
    doubled = np.where(flat, 1.0, doubled)[:, None]
    upright = normal / np.sqrt(doubled)
    rows = (np.cross(second, upright), np.cross(upright, first), normal)
    dual_rows = np.stack([row / doubled for row in rows], axis=1)
    dual_rows[flat] = 0.0
    return dual_rows, np.where(flat, 0.0, 0.5 * doubled[:, 0])


def hat_gradients(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    """Gradients (t, 3, 3) of the hat functions of each triangle's corners, one a row, and areas (t,).

    Those of the second and third corner are the duals d1 and d2; all three sum to 0, since the functions sum to 1.
    """
    rows, areas = duals(frames(points, triangles))
    return np.stack([-rows[:, 0] - rows[:, 1], rows[:, 0], rows[:, 1]], axis=1), areas


def gradient_operator(points: FloatArray, triangles: IntArray) -> tuple[Any, FloatArray]:
    """Sparse (2t, n): values at points to their gradients in the planes of the triangles; and areas (t,).

    Rows 2i and 2i + 1 are the slopes of triangle i along its first edge and across it. Triangles without area have
    rows of zeros.
    """
    from scipy.sparse import csr_array

    hats, areas = hat_gradients(points, triangles)
    first, _, normal = frames(points, triangles).transpose(1, 0, 2)
    across = np.cross(normal, first)
    axes = np.stack([first, across], axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    slopes = axes @ hats.transpose(0, 2, 1)  # (t, 2, 3)
    columns = np.repeat(triangles, 2, axis=0).ravel()
    starts = np.arange(0, 6 * len(triangles) + 1, 3)
    return csr_array((slopes.ravel(), columns, starts), shape=(2 * len(triangles), len(points))), areas


def pieces(count: int, triangles: IntArray) -> IntArray:
    """(count,) number of the piece that each point belongs to, connected through triangles."""
    return components(count, np.concatenate([triangles[:, :2], triangles[:, 1:]]))


@dataclass(frozen=True, kw_only=True)
class TriangleChanges:
    """Changes of t triangles from rest."""

    triangles: IntArray  # (t, 3)
    rest: FloatArray  # (t, 3, 3) duals of the frames at rest, one a row; 0 where a triangle has no area
    areas: FloatArray  # (t,) at rest

    @classmethod
    def from_rest(cls, points: FloatArray, triangles: IntArray) -> TriangleChanges:
        """Changes from `points` (n, 3) at rest."""
        rest, areas = duals(frames(points, triangles))
        return cls(triangles=triangles, rest=rest, areas=areas)

    def at(self, points: FloatArray) -> FloatArray:
        """(t, 3, 3) changes T of the triangles, 0 of those without area at rest."""
        return np.asarray(frames(points, self.triangles).transpose(0, 2, 1) @ self.rest)

    def derivative(self, points: FloatArray) -> FloatArray:
        """(t, 9, 9) derivatives of T, row by row, in the triangle's corners, axes of a corner side by side."""
        by_first, by_second = _normal_derivatives(points, self.triangles)
        along, upright = self.rest[:, :2], self.rest[:, 2]
        derivative = np.zeros((len(self.triangles), 3, 3, 3, 3))  # row and column of T, corner, axis
        for corner, slopes in enumerate((-along.sum(axis=1), along[:, 0], along[:, 1])):
            for axis in range(3):
                derivative[:, axis, :, corner, axis] = slopes
        for corner, normal in enumerate((-by_first - by_second, by_first, by_second)):
            derivative[:, :, :, corner] += normal[:, :, None] * upright[:, None, :, None]
        return derivative.reshape(len(self.triangles), 9, 9)


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """Pairs of triangles with an edge in common, and what the difference between their changes counts."""

    pairs: IntArray  # (p, 2) triangles
    points: IntArray  # (p, 4) corners of the first, then the corner of the second that the first lacks
    second: IntArray  # (p, 3) which of those four the corners of the second are
    weights: FloatArray  # (p,)

    @classmethod
    def across_edges(cls, points: FloatArray, triangles: IntArray, areas: FloatArray) -> Neighbours:
        """Neighbours among triangles with areas (t,) above 0.

        The weights make the sum of squared differences about the integral of the squared gradient of T, on finer
        triangles as on coarser ones.
        """
        pairs, ends = _sharing_edges(np.flatnonzero(areas > 0.0), triangles)
        first_triangles, second_triangles = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
        alike = second_triangles[:, :, None] == first_triangles[:, None, :]
        apex = ~alike.any(axis=2)
        proper = apex.sum(axis=1) == 1  # twice the same triangle has no apex
        last = second_triangles[np.arange(len(second_triangles)), apex.argmax(axis=1)]
        return cls(
            pairs=pairs[proper],
            points=np.concatenate([first_triangles, last[:, None]], axis=1)[proper],
            second=np.where(apex, 3, alike.argmax(axis=2))[proper],
            weights=_weights(points, triangles, areas, pairs, ends)[proper],
        )

    def where(self, points: BoolArray) -> Neighbours:
        """The pairs with some of `points` (n,)."""
        kept = points[self.points].any(axis=1)
        return Neighbours(
            pairs=self.pairs[kept], points=self.points[kept], second=self.second[kept], weights=self.weights[kept]
        )

    def differences(self, changes: FloatArray) -> FloatArray:
        """(p, 9) between changes (t, 3, 3)."""
        return np.asarray((changes[self.pairs[:, 0]] - changes[self.pairs[:, 1]]).reshape(-1, 9))

    def derivative(self, derivative: FloatArray) -> FloatArray:
        """(p, 9, 12) derivatives of the differences in `points`, from those of the changes (t, 9, 9)."""
        slopes = np.zeros((len(self.pairs), 9, 4, 3))
        slopes[:, :, :3] = derivative[self.pairs[:, 0]].reshape(-1, 9, 3, 3)
        other = derivative[self.pairs[:, 1]].reshape(-1, 9, 3, 3)
        rows = np.arange(len(self.pairs))
        for corner in range(3):
            slopes[rows, :, self.second[:, corner]] -= other[:, :, corner]
        return slopes.reshape(-1, 9, 12)


def _weights(points: FloatArray, triangles: IntArray, areas: FloatArray, pairs: IntArray, ends: IntArray) -> FloatArray:
    """(p,) ``l h / max(|c1 - c2|^2, h^2)``: the area at an edge of length l between two centroids c, times the inverse
    square of their distance, with their distance across the edge ``h = (A1 + A2) / 1.5 l``.

    These areas cover the surface twice, and differences along one direction see half of a gradient's square: the sum
    of weighted squared differences is about the integral of ``|grad T|^2``.
    """
    tiny = np.finfo(np.float64).tiny
    length = np.maximum(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1), np.sqrt(tiny))
    across = areas[pairs].sum(axis=1) / (1.5 * length)
    centroids = points[triangles].mean(axis=1)
    apart = ((centroids[pairs[:, 0]] - centroids[pairs[:, 1]]) ** 2).sum(axis=1)
    return np.asarray(length * across / np.maximum(apart, across**2))  # at a fold the straight distance is too short


def _normal_derivatives(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    """(t, 3, 3) derivatives of the scaled normal in the first and in the second edge; 0 without area.

    With ``c = e1 x e2``, ``n = c / sqrt(|c|)`` and ``u = c / |c|``: ``dn = (1 - u u^T / 2) dc / sqrt(|c|)`` and
    ``dc = e1 x de2 - e2 x de1``.
    """
    a, b, c = points[triangles].transpose(1, 0, 2)
    first, second = b - a, c - a
    cross = np.cross(first, second)
    length = np.maximum(np.linalg.norm(cross, axis=1), np.finfo(np.float64).tiny)
    unit = cross / length[:, None]
    scaled = (np.eye(3) - 0.5 * unit[:, :, None] * unit[:, None, :]) / np.sqrt(length)[:, None, None]
    return -scaled @ _crossing(second), scaled @ _crossing(first)


def _crossing(vectors: FloatArray) -> FloatArray:
    """(t, 3, 3) matrices M with ``M w = v x w``."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _sharing_edges(used: IntArray, triangles: IntArray) -> tuple[IntArray, IntArray]:
    """(p, 2) of the `used` triangles that share an edge, and its ends (p, 2); at an edge of more than two, in a row."""
    ends = np.sort(triangles[used][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(used, 3)
    order = np.lexsort((owner, ends[:, 1], ends[:, 0]))
    ends, owner = ends[order], owner[order]
    same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    return np.stack([owner[same], owner[same + 1]], axis=1), ends[same]
