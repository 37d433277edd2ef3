"""Frames and gradients of triangles, and the transfer of deformations to a face of the topology that lacks a shape.

The gradient of a deformation over a triangle is the 3 x 3 matrix S that takes two edges and the scaled normal
``n = e1 x e2 / sqrt(|e1 x e2|)`` of the undeformed triangle to those of the deformed one (Sumner & Popović,
"Deformation Transfer for Triangle Meshes", SIGGRAPH 2004, section 3: the normal is their fourth vertex). Their transfer
is the least-squares fit of the target's gradients to the source's. The target's fourth vertices are free and each
belongs to one triangle, so they take up the part of S along the target's normal without cost and drop out. What is left
is the Poisson system of Botsch, Sumner, Pauly & Gross, "Deformation Transfer for Detail-Preserving Surface Editing",
VMV 2006, weighted by area: a cotangent Laplacian in the points alone, solved here for displacements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.factor import factorise
from facepipe.geometry.polygons import components
from facepipe.geometry.vectors import finite, group_sums

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
        # (t, 3, 3) derivatives of the scaled normal in the first and in the second edge; 0 without area. With ``c = e1
        # x e2``, ``n = c / sqrt(|c|)`` and ``u = c / |c|``: ``dn = (1 - u u^T / 2) dc / sqrt(|c|)`` and ``dc = e1 x de2
        # - e2 x de1``.
        a, b, c = points[self.triangles].transpose(1, 0, 2)
        first, second = b - a, c - a
        cross = np.cross(first, second)
        length = np.maximum(np.linalg.norm(cross, axis=1), np.finfo(np.float64).tiny)
        unit = cross / length[:, None]
        scaled = (np.eye(3) - 0.5 * unit[:, :, None] * unit[:, None, :]) / np.sqrt(length)[:, None, None]
        by_first, by_second = -scaled @ _crossing(second), scaled @ _crossing(first)
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
        used = np.flatnonzero(areas > 0.0)
        # (p, 2) of the `used` triangles that share an edge, and its ends (p, 2); at an edge of more than two, in a row
        ends = np.sort(triangles[used][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        owner = np.repeat(used, 3)
        order = np.lexsort((owner, ends[:, 1], ends[:, 0]))
        ends, owner = ends[order], owner[order]
        same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
        pairs, ends = np.stack([owner[same], owner[same + 1]], axis=1), ends[same]
        first_triangles, second_triangles = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
        alike = second_triangles[:, :, None] == first_triangles[:, None, :]
        apex = ~alike.any(axis=2)
        proper = apex.sum(axis=1) == 1  # twice the same triangle has no apex
        last = second_triangles[np.arange(len(second_triangles)), apex.argmax(axis=1)]
        # (p,) ``l h / max(|c1 - c2|^2, h^2)``: the area at an edge of length l between two centroids c, times the
        # inverse square of their distance, with their distance across the edge ``h = (A1 + A2) / 1.5 l``. These areas
        # cover the surface twice, and differences along one direction see half of a gradient's square: the sum of
        # weighted squared differences is about the integral of ``|grad T|^2``.
        tiny = np.finfo(np.float64).tiny
        length = np.maximum(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1), np.sqrt(tiny))
        across = areas[pairs].sum(axis=1) / (1.5 * length)
        centroids = points[triangles].mean(axis=1)
        apart = ((centroids[pairs[:, 0]] - centroids[pairs[:, 1]]) ** 2).sum(axis=1)
        # at a fold the straight distance is too short
        return cls(
            pairs=pairs[proper],
            points=np.concatenate([first_triangles, last[:, None]], axis=1)[proper],
            second=np.where(apex, 3, alike.argmax(axis=2))[proper],
            weights=np.asarray(length * across / np.maximum(apart, across**2))[proper],
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


def _crossing(vectors: FloatArray) -> FloatArray:
    """(t, 3, 3) matrices M with ``M w = v x w``."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


class Transfer:
    """One face, ready to take over deformations from others on its topology.

    Minimises ``sum_t area_t |grad(x) - S_t grad(neutral)|^2`` over the triangles t, in a frame of axes that all faces
    share: moving any neutral together with its deformed points changes nothing; moving or uniformly scaling this face
    moves or scales the result. Turning it alone does not turn the deformation: a jaw that opens downwards still does.
    Only where the sources turn along is the result turned. A piece that the source turns and uniformly scales as a
    whole is turned and scaled alike (general affine maps are not: the scaled normal does not follow them).

    Where gradients leave displacements open, they are those of the sources: the mean, each multiplied by this face's
    size over the source's (size: RMS distance of all points from their centroid).

    - A piece without fixed points (connected through triangles that have an area here: an eyeball, a tooth, a point
      alone): its centroid moves by the mean displacement of its points.
    - A triangle without area in all sources of a `solve`: its gradient is that of the mean displacements. One without
      area in some sources takes the mean of the others.

    :param points: (n, 3) neutral of the face that lacks the shape
    :param triangles: (t, 3) points of each triangle
    :param fixed: (n,) points that keep their place, to the bit
    :raises InputError: NaN or infinity
    """

    def __init__(self, points: FloatArray, triangles: IntArray, fixed: BoolArray) -> None:
        from scipy.sparse import coo_array

        self._points = finite("points", points)
        self._triangles, self._fixed = np.asarray(triangles, np.int64), fixed
        self._hats, self._areas = hat_gradients(self._points, self._triangles)
        used = self._triangles[self._areas > 0]
        self._pieces = components(len(self._points), np.concatenate([used[:, :2], used[:, 1:]]))
        anchored = np.bincount(self._pieces, self._fixed) > 0
        self._floating = ~anchored[self._pieces]
        first = np.unique(self._pieces, return_index=True)[1]  # holds a floating piece while it is solved for
        held = self._fixed.copy()
        held[first] |= self._floating[first]
        self._free = np.flatnonzero(~held)
        # the hat functions' Dirichlet products ``L_ij = sum_t area_t grad_i . grad_j``: cotangents
        products = self._areas[:, None, None] * (self._hats @ self._hats.transpose(0, 2, 1))
        rows = np.repeat(self._triangles, 3, axis=1).ravel()
        columns = np.tile(self._triangles, (1, 3)).ravel()
        count = len(self._points)
        self._factor = factorise(
            coo_array((products.ravel(), (rows, columns)), shape=(count, count)).tocsr()[self._free][:, self._free]
        )

    def solve(self, neutrals: FloatArray, deformed: FloatArray) -> FloatArray:
        """The deformed points (n, 3) of this face.

        :param neutrals: (m, n, 3) of the sources, one at least
        :param deformed: (m, n, 3) of the sources
        :raises InputError: NaN or infinity
        """
        neutrals, deformed = finite("neutrals", neutrals), finite("deformed", deformed)
        # displacements of the sources, brought to the size of this face, and their gradients S - I
        mean, share = np.zeros_like(self._points), 1.0 / len(neutrals)
        gradients, total = np.zeros((len(self._triangles), 3, 3)), np.zeros(len(self._triangles))
        for neutral, shape in zip(neutrals, deformed, strict=True):
            size = spread(neutral)
            mean += share * (spread(self._points) / size if size > 0 else 1.0) * (shape - neutral)
            rest = frames(neutral, self._triangles)
            rows, areas = duals(rest)
            change = frames(shape, self._triangles) - rest  # exactly 0 where nothing moves
            gradients += share * (change.transpose(0, 2, 1) @ rows)
            total += share * (areas > 0)
        unknown = total <= 0
        gradients[~unknown] /= total[~unknown, None, None]
        gradients[unknown] = mean[self._triangles[unknown]].transpose(0, 2, 1) @ self._hats[unknown]
        # (n, 3) right-hand side of the normal equations, ``b_i = sum_t area_t G_t grad_i`` with gradients G
        flux = self._areas[:, None, None] * (self._hats @ gradients.transpose(0, 2, 1))
        divergence = group_sums(self._triangles.ravel(), flux.reshape(-1, 3), len(self._points))
        moved = np.zeros_like(self._points)
        moved[self._free] = self._factor.solve(divergence[self._free])
        counts = np.bincount(self._pieces)
        piece_means = group_sums(self._pieces, mean - moved, len(counts)) / counts[:, None]
        moved[self._floating] += piece_means[self._pieces][self._floating]
        result = self._points + moved
        result[self._fixed] = self._points[self._fixed]
        return np.asarray(result)


def spread(points: FloatArray) -> float:
    """Root mean square distance of points (n, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
