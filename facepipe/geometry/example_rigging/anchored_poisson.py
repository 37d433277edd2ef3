"""Points from gradients and, weakly, from points: one factor for all shapes."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.example_rigging.examples import Examples
from facepipe.geometry.factor import factorise
from facepipe.geometry.triangle_frames import gradient_operator


class AnchoredPoisson:
    """Minimises ``sum_t area_t |grad x - g_t|^2 + sum_i area_i |x_i - p_i|^2 / length^2`` over the neutral.

    Gradients decide what is finer than the length, points what is coarser: where a whole piece is, above all, of which
    gradients know nothing.

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
