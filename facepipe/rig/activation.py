"""Activation of a shape's sculpts, its own and those of its inbetweens, by its weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray


@dataclass(frozen=True)
class Curve:
    """A piecewise-linear curve through `knots` (weight, activation), its end pieces extended without end.

    UsdSkel interpolates between neutral (0), the inbetweens and the shape (1) and extrapolates beyond them
    (`UsdSkelBlendShapeQuery::ComputeSubShapeWeights`).
    """

    knots: tuple[tuple[float, float], ...]

    def __call__(self, weight: FloatArray | float) -> FloatArray:
        """Activation at `weight`, of the same shape."""
        weight = np.asarray(weight, dtype=np.float64)
        base, slope, bends = self.hinges()
        result = base + slope * weight
        for at, change in bends:
            result = result + change * np.maximum(weight - at, 0.0)
        return np.asarray(result)

    def hinges(self) -> tuple[float, float, tuple[tuple[float, float], ...]]:
        """The curve as ``base + slope * w + sum(change * relu(w - at))``: base, slope, ((at, change), ...)."""
        x, y = np.array(self.knots, dtype=np.float64).T
        slopes = np.diff(y) / np.diff(x)
        bends = tuple((float(x[i]), float(slopes[i] - slopes[i - 1])) for i in range(1, len(slopes)))
        return float(y[0] - slopes[0] * x[0]), float(slopes[0]), bends

    @property
    def is_identity(self) -> bool:
        """Whether the activation is the weight itself."""
        return all(abs(x - y) == 0 for x, y in self.knots)


def curves(inbetween_weights: tuple[float, ...]) -> dict[float, Curve]:
    """The curve of every sculpt of a shape, by its weight: each inbetween's and 1 for the shape itself.

    `inbetween_weights` are distinct and neither 0 nor 1.
    """
    knots = sorted({0.0, 1.0, *inbetween_weights})
    return {sculpt: Curve(tuple((knot, float(knot == sculpt)) for knot in knots)) for sculpt in knots if sculpt != 0.0}
