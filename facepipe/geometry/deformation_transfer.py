"""Deformation-gradient transfer between faces on one topology: a shape for the face that lacks it.

The gradient of a deformation over a triangle is the 3 x 3 matrix S that takes two edges and the scaled normal
``n = e1 x e2 / sqrt(|e1 x e2|)`` of the undeformed triangle to those of the deformed one (Sumner & Popović,
"Deformation Transfer for Triangle Meshes", SIGGRAPH 2004, section 3: the normal is their fourth vertex). Their transfer
is the least-squares fit of the target's gradients to the source's. The target's fourth vertices are free and each
belongs to one triangle, so they take up the part of S along the target's normal without cost and drop out. What is left
is the Poisson system of Botsch, Sumner, Pauly & Gross, "Deformation Transfer for Detail-Preserving Surface Editing",
VMV 2006, weighted by area: a cotangent Laplacian in the points alone, solved here for displacements.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.factor import factorise
from facepipe.geometry.triangle_frames import duals, frames, hat_gradients, pieces
from facepipe.geometry.vectors import finite, group_sums


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
        self._points = finite("points", points)
        self._triangles, self._fixed = np.asarray(triangles, np.int64), fixed
        self._hats, self._areas = hat_gradients(self._points, self._triangles)
        self._pieces = pieces(len(self._points), self._triangles[self._areas > 0])
        anchored = np.bincount(self._pieces, self._fixed) > 0
        self._floating = ~anchored[self._pieces]
        first = np.unique(self._pieces, return_index=True)[1]  # holds a floating piece while it is solved for
        held = self._fixed.copy()
        held[first] |= self._floating[first]
        self._free = np.flatnonzero(~held)
        self._factor = factorise(self._laplacian()[self._free][:, self._free])

    def solve(self, neutrals: FloatArray, deformed: FloatArray) -> FloatArray:
        """The deformed points (n, 3) of this face.

        :param neutrals: (m, n, 3) of the sources, one at least
        :param deformed: (m, n, 3) of the sources
        :raises InputError: NaN or infinity
        """
        neutrals, deformed = finite("neutrals", neutrals), finite("deformed", deformed)
        mean = self._mean_displacements(neutrals, deformed)
        divergence = self._divergence(self._gradients(neutrals, deformed, mean))
        moved = np.zeros_like(self._points)
        moved[self._free] = self._factor.solve(divergence[self._free])
        moved[self._floating] += self._piece_means(mean - moved)[self._floating]
        result = self._points + moved
        result[self._fixed] = self._points[self._fixed]
        return np.asarray(result)

    def _laplacian(self) -> Any:
        """(n, n) sparse, the hat functions' Dirichlet products ``L_ij = sum_t area_t grad_i . grad_j``: cotangents."""
        from scipy.sparse import coo_array

        products = self._areas[:, None, None] * (self._hats @ self._hats.transpose(0, 2, 1))
        rows = np.repeat(self._triangles, 3, axis=1).ravel()
        columns = np.tile(self._triangles, (1, 3)).ravel()
        count = len(self._points)
        return coo_array((products.ravel(), (rows, columns)), shape=(count, count)).tocsr()

    def _mean_displacements(self, neutrals: FloatArray, deformed: FloatArray) -> FloatArray:
        """(n, 3) displacements of the sources, brought to the size of this face."""
        mean, share = np.zeros_like(self._points), 1.0 / len(neutrals)
        for neutral, shape in zip(neutrals, deformed, strict=True):
            size = spread(neutral)
            mean += share * (spread(self._points) / size if size > 0 else 1.0) * (shape - neutral)
        return mean

    def _gradients(self, neutrals: FloatArray, deformed: FloatArray, mean: FloatArray) -> FloatArray:
        """(t, 3, 3) gradients of the displacements: the sources' mean S - I."""
        summed = np.zeros((len(self._triangles), 3, 3))
        total, share = np.zeros(len(self._triangles)), 1.0 / len(neutrals)
        for neutral, shape in zip(neutrals, deformed, strict=True):
            rest = frames(neutral, self._triangles)
            rows, areas = duals(rest)
            change = frames(shape, self._triangles) - rest  # exactly 0 where nothing moves
            summed += share * (change.transpose(0, 2, 1) @ rows)
            total += share * (areas > 0)
        unknown = total <= 0
        summed[~unknown] /= total[~unknown, None, None]
        summed[unknown] = mean[self._triangles[unknown]].transpose(0, 2, 1) @ self._hats[unknown]
        return summed

    def _divergence(self, gradients: FloatArray) -> FloatArray:
        """(n, 3) right-hand side of the normal equations, ``b_i = sum_t area_t G_t grad_i`` with gradients G."""
        flux = self._areas[:, None, None] * (self._hats @ gradients.transpose(0, 2, 1))
        return group_sums(self._triangles.ravel(), flux.reshape(-1, 3), len(self._points))

    def _piece_means(self, values: FloatArray) -> FloatArray:
        """(n, 3) the mean of `values` over each point's piece."""
        counts = np.bincount(self._pieces)
        sums = group_sums(self._pieces, values, len(counts))
        return np.asarray((sums / counts[:, None])[self._pieces])


def spread(points: FloatArray) -> float:
    """Root mean square distance of points (n, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
