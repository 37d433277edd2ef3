"""Smooth random fields over points as sums of few functions."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

_JITTER = 1e-6  # of the nodes' covariance: keeps its factor definite
_EVERYWHERE = 0.25  # share of the variance that is the same at all points


def spread_points(points: FloatArray, spacing: float) -> IntArray:
    """Indices of points such that none of all is further than `spacing` from one of them, each far from the others.

    The first is the one furthest from the centroid, every next one that furthest from all before.
    """
    nearest = ((points - points.mean(axis=0)) ** 2).sum(axis=1)
    chosen = [int(nearest.argmax())]
    nearest = np.full(len(points), np.inf)
    columns = np.ascontiguousarray(points.T)
    while True:
        apart = sum((axis - axis[chosen[-1]]) ** 2 for axis in columns)
        np.minimum(nearest, apart, out=nearest)
        furthest = int(nearest.argmax())
        if nearest[furthest] <= spacing * spacing:
            return np.array(chosen)
        chosen.append(furthest)


class SmoothBasis:
    """Functions f_k such that ``sum_k z_k f_k`` with independent z_k of spread 1 has the covariance
    ``1/4 + 3/4 exp(-|x - y|^2 / 2 length^2)`` near the nodes: a quarter of the variance is the same everywhere, f_0,
    the rest a Gaussian process by its values at the nodes (Quiñonero-Candela & Rasmussen, "A unifying view of sparse
    approximate Gaussian process regression", JMLR 2005, section 4).

    :param nodes: (k, 3)
    """

    def __init__(self, nodes: FloatArray, length: float) -> None:
        self.nodes, self._length = nodes, length
        self._factor = np.linalg.cholesky(self._covariance(nodes) + _JITTER * np.eye(len(nodes)))

    def __len__(self) -> int:
        return 1 + len(self.nodes)

    def __call__(self, points: FloatArray) -> FloatArray:
        """(p, k) values of the functions at points (p, 3)."""
        from scipy.linalg import solve_triangular

        values = np.full((len(self), len(points)), np.sqrt(_EVERYWHERE))
        values[1:] = solve_triangular(self._factor, self._covariance(points).T, lower=True, overwrite_b=True)
        values[1:] *= np.sqrt(1.0 - _EVERYWHERE)
        return np.asarray(values.T)

    def _covariance(self, points: FloatArray) -> FloatArray:
        scaled, nodes = points / self._length, self.nodes / self._length
        squares = (scaled * scaled).sum(axis=1)[:, None] + (nodes * nodes).sum(axis=1) - 2.0 * scaled @ nodes.T
        return np.asarray(np.exp(-0.5 * np.maximum(squares, 0.0)))
