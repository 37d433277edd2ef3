"""The input of a split, checked: the neutral, the templates, and scanned composites with their weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
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


def checked(
    neutral: FloatArray,
    templates: FloatArray,
    composites: FloatArray,
    weights: FloatArray,
    triangles: IntArray,
    point_weights: FloatArray | None,
    stiff: IntArray | None,
) -> Examples:
    """The examples; arguments and errors as those of `split_shapes`."""
    points: FloatArray = finite("neutral", neutral)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise TopologyError("neutral", f"shape {points.shape}, expected (n, 3) with n at least 1")
    count = len(points)
    deltas = _sized("template deltas", templates, (None, count, 3))
    scanned = _sized("composites", composites, (None, count, 3))
    shape_weights = _sized("weights", weights, (len(scanned), len(deltas)))
    for number in np.flatnonzero(~shape_weights.any(axis=1)):
        raise InputError(f"weights -> composite {number}", "all are 0, expected one shape at least")
    if point_weights is None:
        confidence: FloatArray = np.ones((len(scanned), count))
    else:
        confidence = _sized("point weights", point_weights, (len(scanned), count))
        if confidence.min(initial=0.0) < 0 or confidence.max(initial=0.0) > 1:
            raise InputError("point weights", "expected numbers from 0 to 1")
    corners = _corners(triangles, count)
    areas: FloatArray = point_areas(points, corners)
    least = 1e-6 * (areas.mean() or 1.0)
    return Examples(
        neutral=points,
        triangles=corners,
        templates=deltas,
        offsets=scanned - points,
        weights=shape_weights,
        confidence=confidence,
        areas=np.maximum(areas, least),
        stiff=_labels(stiff, count),
    )


def _sized(name: str, values: FloatArray, shape: tuple[int | None, ...]) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits or not len(array):
        expected = ", ".join("1 or more" if size is None else str(size) for size in shape)
        raise TopologyError(name, f"shape {array.shape}, expected ({expected})")
    return finite(name, array)


def _corners(triangles: IntArray, count: int) -> IntArray:
    corners = np.asarray(triangles)
    if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu" or not len(corners):
        raise TopologyError("triangles", f"{corners.dtype} of shape {corners.shape}, expected integers (t, 3)")
    if corners.min() < 0 or corners.max() >= count:
        raise TopologyError("triangles", f"points {corners.min()} to {corners.max()}, expected 0 to {count - 1}")
    return corners.astype(np.int64)


def _labels(stiff: IntArray | None, count: int) -> IntArray:
    if stiff is None:
        return np.full(count, -1)
    labels = np.asarray(stiff)
    if labels.shape != (count,) or labels.dtype.kind not in "iu":
        raise TopologyError("stiff", f"{labels.dtype} of shape {labels.shape}, expected {count} integers")
    return np.maximum(labels.astype(np.int64), -1)
