"""Smooth deformations of any kind as modes, for faces that no model of people shows."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_LEAST_VARIANCE = 1e-3  # of the largest: modes below it are nothing but rounding and noise


def smooth_modes(points: FloatArray, length: float, deviation: float, count: int) -> FloatArray:
    """(k, n, 3) deformations, by independent standard normal weights a Gaussian process of
    ``deviation^2 exp(-|x - y|^2 / (2 length^2))`` in each axis.

    Its covariance by what points (n, 3) have in common with `count` of them, spread as evenly as can be (Nyström):
    Lüthi, Gerig, Jud and Vetter, "Gaussian Process Morphable Models", IEEE TPAMI 2018, section 4.

    :param length: over which points move alike, in the points' unit
    :param deviation: of a point along an axis
    """
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(nearest.argmax()))
    centres = points[chosen]
    variances, turned = np.linalg.eigh(_alike(centres, centres, length))
    kept = variances > _LEAST_VARIANCE * variances[-1]
    along = deviation * _alike(points, centres, length) @ (turned[:, kept] / np.sqrt(variances[kept]))
    return np.asarray(np.einsum("nk,ai->akni", along, np.eye(3)).reshape(-1, *points.shape))


def _alike(points: FloatArray, others: FloatArray, length: float) -> FloatArray:
    squares = ((points[:, None] - others) ** 2).sum(axis=2)
    return np.asarray(np.exp(-squares / (2.0 * length**2)))
