"""Smooth warps of space that take landmarks to landmarks.

A similarity, and a sum of biharmonic kernels for what it leaves: in three dimensions the kernel of least bending is the
distance itself,

    warp(x) = y + c + sum_i w_i |y - y_i|,    y = s R x + t,    sum_i w_i = 0

so that far from the landmarks the warp goes over into the similarity and a bounded shift, as the kernels' affine part,
which would grow without end, is left out.

Source: Bookstein, "Principal warps", PAMI 1989, and Carr et al., "Reconstruction and representation of 3D objects with
radial basis functions", SIGGRAPH 2001, section 3 (biharmonic splines in space, smoothing).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import Similarity, fit_similarity

_PAIRS_AT_ONCE = 1 << 22  # point-landmark pairs at a time: a bound on memory


@dataclass(frozen=True, kw_only=True)
class Warp:
    """A warp of space."""

    similarity: Similarity
    centres: FloatArray  # (l, 3) where the similarity takes the landmarks
    weights: FloatArray  # (l, 3), in sum 0
    shift: FloatArray  # (3,)

    def apply(self, points: FloatArray) -> FloatArray:
        """(n, 3) points moved."""
        moved = self.similarity.apply(points)
        for part in _parts(len(moved), len(self.centres)):
            away = np.linalg.norm(moved[part, None] - self.centres, axis=2)
            moved[part] += self.shift + away @ self.weights
        return moved

    def jacobians(self, points: FloatArray) -> FloatArray:
        """(n, 3, 3) derivatives of the moved points by the points; at a landmark its own kernel counts nothing."""
        at = self.similarity.apply(points)
        linear = self.similarity.scale * self.similarity.rotation
        jacobians = np.empty((len(at), 3, 3))
        for part in _parts(len(at), len(self.centres)):
            offset = at[part, None] - self.centres
            away = np.linalg.norm(offset, axis=2, keepdims=True)
            slopes = np.divide(offset, away, out=np.zeros_like(offset), where=away > 0)
            jacobians[part] = (np.eye(3) + np.einsum("lk,nli->nki", self.weights, slopes)) @ linear
        return jacobians


def _parts(points: int, centres: int) -> list[slice]:
    step = max(1, _PAIRS_AT_ONCE // max(centres, 1))
    return [slice(at, at + step) for at in range(0, points, step)]


def fit_warp(source: FloatArray, target: FloatArray, smoothing: float = 0.0) -> Warp:
    """The warp of least bending that takes `source` (l, 3) to `target` (l, 3), l at least 4.

    :param smoothing: a length, 0 or more: landmarks are missed by about as much where that saves bending; it keeps
        those apart that lie on one another, such as closed lips'
    :raises InputError: NaN or infinity
    """
    similarity = fit_similarity(source, target)
    centres = similarity.apply(source)
    count = len(centres)
    away = np.linalg.norm(centres[:, None] - centres, axis=2)
    system = np.zeros((count + 1, count + 1))
    system[:count, :count] = away - smoothing * np.eye(count)  # the distance is negative definite where sums are 0
    system[:count, count] = system[count, :count] = 1.0
    right = np.concatenate([np.asarray(target, np.float64) - centres, np.zeros((1, 3))])
    solved = np.linalg.solve(system, right)
    return Warp(similarity=similarity, centres=centres, weights=solved[:count], shift=solved[count])


def nearest_rotations(matrices: FloatArray) -> FloatArray:
    """(n, 3, 3) the rotation nearest to each of (n, 3, 3) matrices (polar decomposition, never a reflection)."""
    U, _, Vt = np.linalg.svd(matrices)
    signs = np.ones((len(matrices), 3))
    signs[:, 2] = np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)
    return np.asarray((U * signs[:, None, :]) @ Vt)
