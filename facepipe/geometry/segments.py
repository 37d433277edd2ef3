"""Distances from line segments."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray


def to_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(n,) distances of points (n, 3) from the segment between two places (3,)."""
    along = end - start
    t = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - t[:, None] * along, axis=1))
