"""Residuals of the composites after gains and turns, divided among the shapes by point and by triangle.

Each composite's rest is a weighted sum of what its shapes lack. Of all such sums the most probable one is taken, given
how much each shape may lack here: a share of its template's motion, and of the slope of that motion, at this place. So
what only one shape of a composite moves is its own, what two of them move is divided, and a triangle that no template
moves stays still. Li, Weise & Pauly, "Example-Based Facial Rigging", SIGGRAPH 2010, section 4, hold per-triangle
gradients to the template's in this way; gradients are taken in the planes of the triangles here, where they are linear
in the points (the fourth vertex, along the normal, is free in the reconstruction and drops out of it).
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.example_rigging.examples import Examples
from facepipe.geometry.example_rigging.options import SplitOptions
from facepipe.geometry.factor import factorise
from facepipe.geometry.triangle_frames import gradient_operator

_PLACES_AT_ONCE = 4096  # places at a time: a bound on memory


def added_detail(
    examples: Examples, weights: FloatArray, residuals: FloatArray, deltas: FloatArray, options: SplitOptions
) -> FloatArray:
    """(x, n, 3) what the excited shapes gain from residuals (c, n, 3).

    :param deltas: (x, n, 3) of the excited shapes so far
    """
    chosen = weights[:, examples.excited]
    poisson = AnchoredPoisson(examples, options.detail_length)
    motion = poisson.smooth(np.linalg.norm(deltas, axis=2).T)  # (n, x)
    motion[examples.stiff >= 0] = 0.0
    from_points = dealt_out(
        chosen, options.detail * motion, options.noise, examples.confidence.T, residuals.transpose(1, 0, 2)
    )
    corners = examples.triangles
    slopes = poisson.gradient @ _columns(residuals)  # (2t, 3c)
    slopes = slopes.reshape(len(corners), 2, len(residuals), 3).transpose(0, 2, 1, 3).reshape(len(corners), -1, 6)
    steep = _steepness(poisson, deltas) + motion[corners].mean(axis=1) / options.field_length
    steep[(examples.stiff[corners] >= 0).any(axis=1)] = 0.0
    trusted = examples.confidence[:, corners].min(axis=2).T
    noise = options.noise / options.noise_length
    from_slopes = dealt_out(chosen, options.detail * steep, noise, trusted, slopes)  # (t, x, 6)
    count = chosen.shape[1]
    from_slopes = from_slopes.reshape(-1, count, 2, 3).transpose(0, 2, 1, 3).reshape(-1, 3 * count)
    found = poisson.solve(from_slopes, from_points.reshape(-1, 3 * count))
    return np.ascontiguousarray(found.reshape(-1, count, 3).transpose(1, 0, 2))


def dealt_out(
    weights: FloatArray, spread: FloatArray, noise: float, confidence: FloatArray, values: FloatArray
) -> FloatArray:
    """(p, x, d) the most probable parts of shapes in values (p, c, d) of composites, place by place.

    ``S A^T C (C A S A^T C + noise^2)^-1 C values`` with weights A, ``S = diag(spread^2)`` and ``C^2 = confidence``.

    :param weights: (c, x)
    :param spread: (p, x) of the parts
    :param noise: spread of the values' errors
    :param confidence: (p, c) 0..1
    """
    probable = np.empty((len(values), weights.shape[1], values.shape[2]))
    for part in parts(len(values)):
        shares, covariance, trusted = normal_equations(weights, spread[part], noise, confidence[part])
        solved = np.linalg.solve(covariance, trusted[:, :, None] * values[part])
        probable[part] = shares.transpose(0, 2, 1) @ solved
    return probable


def normal_equations(
    weights: FloatArray, spread: FloatArray, noise: float, confidence: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``C A S`` (p, c, x), ``C A S A^T C + noise^2`` (p, c, c) and the diagonal of C (p, c)."""
    trusted = np.sqrt(confidence)
    shares = trusted[:, :, None] * weights * (spread * spread)[:, None, :]
    covariance = (shares @ weights.T) * trusted[:, None, :]
    covariance += noise * noise * np.eye(len(weights))
    return shares, covariance, trusted


def _steepness(poisson: AnchoredPoisson, deltas: FloatArray) -> FloatArray:
    """(t, x) the length of each shape's gradient."""
    found = [np.square(poisson.gradient @ delta).reshape(-1, 6).sum(axis=1) for delta in deltas]
    return np.asarray(np.sqrt(np.array(found).T))


def _columns(values: FloatArray) -> FloatArray:
    """(n, 3k) of (k, n, 3)."""
    return np.asarray(values.transpose(1, 0, 2).reshape(values.shape[1], -1))


def parts(count: int) -> list[slice]:
    """Slices of `count` places."""
    return [slice(start, start + _PLACES_AT_ONCE) for start in range(0, count, _PLACES_AT_ONCE)]


class AnchoredPoisson:
    """Minimises ``sum_t area_t |grad x - g_t|^2 + sum_i area_i |x_i - p_i|^2 / length^2`` over the neutral.

    Gradients decide what is finer than the length, points what is coarser, above all where a whole piece is: gradients
    leave that free.

    :ivar gradient: sparse (2t, n), rows 2i and 2i + 1 in the plane of triangle i
    """

    def __init__(self, examples: Examples, length: float) -> None:
        from scipy.sparse import diags_array

        self.gradient, areas = gradient_operator(examples.neutral, examples.triangles)
        self._divergence = (self.gradient.T @ diags_array(np.repeat(areas, 2))).tocsr()
        self._hold = examples.areas / length**2
        self._factor = factorise(self._divergence @ self.gradient + diags_array(self._hold))

    def solve(self, gradients: FloatArray, points: FloatArray) -> FloatArray:
        """(n, k) from gradients (2t, k) and points (n, k)."""
        return self._factor.solve(self._divergence @ gradients + self._hold[:, None] * points)

    def smooth(self, values: FloatArray) -> FloatArray:
        """(n, k) values (n, k) diffused over the length; none becomes negative that was not."""
        return np.maximum(self._factor.solve(self._hold[:, None] * values), 0.0)
