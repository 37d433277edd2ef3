"""A face that can follow a scan: what it looks like by its model, and what lies beyond the model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def no_labels() -> IntArray:
    """No label."""
    return np.zeros(0, np.int64)


@dataclass(frozen=True, kw_only=True)
class DeformableSurface:
    """``points = base + sum_k coefficient_k mode_k + residual``, in millimetres, n points.

    Coefficients have a Gaussian prior: `expected`, with variance 1 / `precision`. The residual is a membrane on the
    base, at rest where nothing pulls.
    """

    base: FloatArray  # (n, 3)
    modes: FloatArray  # (k, n, 3)
    expected: FloatArray  # (k,)
    precision: FloatArray  # (k,) above 0
    triangles: IntArray  # (t, 3)
    seen: IntArray  # (m,) points that a scan shows: those look for their places
    held: FloatArray  # (n,) 0 or more: how much the residual is drawn to 0 where it should stay, per mm^2 of area
    labels: IntArray = field(default_factory=no_labels)  # (n,) or none: points of +a and -a never correspond

    def points(self, coefficients: FloatArray, residual: FloatArray | float = 0.0) -> FloatArray:
        """(n, 3)."""
        return np.asarray(self.base + np.tensordot(coefficients, self.modes, axes=1) + residual)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a scan shows besides the surface, such as an expression: modes with weights of a Gaussian prior."""

    modes: FloatArray  # (k, n, 3)
    expected: FloatArray  # (k,)
    precision: FloatArray  # (k,) above 0

    @classmethod
    def nothing(cls, count: int) -> Shown:
        """The surface of `count` points as it is."""
        return cls(modes=np.zeros((0, count, 3)), expected=np.zeros(0), precision=np.zeros(0))
