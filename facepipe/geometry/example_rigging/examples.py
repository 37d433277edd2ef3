"""The input of a split: the neutral, the templates, and scanned composites with their weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.vectors import finite


@dataclass(frozen=True, kw_only=True)
class Examples:
    """Arrays that fit each other, float64 and finite."""

    neutral: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3)
    templates: FloatArray  # (e, n, 3) deltas
    offsets: FloatArray  # (c, n, 3) composites less the neutral
    weights: FloatArray  # (c, e) as given
    confidence: FloatArray  # (c, n) 0..1
    areas: FloatArray  # (n,) of the neutral around each point, above 0
    stiff: IntArray  # (n,) the piece that bends no more than its templates, -1 for none

    @property
    def excited(self) -> IntArray:
        """The shapes that some composite holds."""
        return np.flatnonzero(self.weights.any(axis=0))

    def residuals(self, deltas: FloatArray, weights: FloatArray) -> FloatArray:
        """(c, n, 3) what `deltas` (e, n, 3) with `weights` (c, e) leave of the composites."""
        return self.offsets - np.tensordot(weights, deltas, axes=1)


def examples_of(
    neutral: FloatArray,
    templates: FloatArray,
    composites: FloatArray,
    weights: FloatArray,
    triangles: IntArray,
    confidence: FloatArray,
    stiff: IntArray,
) -> Examples:
    """The examples; arguments and errors as those of `split_shapes`."""
    points = finite("neutral", neutral)
    areas = point_areas(points, triangles)
    return Examples(
        neutral=points,
        triangles=np.asarray(triangles, np.int64),
        templates=finite("template deltas", templates),
        offsets=finite("composites", composites) - points,
        weights=weights,
        confidence=confidence,
        # a point without a triangle has no area: with a hold of 0 the detail's system would be singular there
        areas=np.maximum(areas, 1e-6 * (areas.mean() or 1.0)),
        stiff=np.maximum(np.asarray(stiff, np.int64), -1),
    )
