"""Normals of several sources blended, and normal offsets of shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.vectors import unit_vectors

_DEGENERATE = 1e-6  # a sum of unit vectors shorter than this has no direction


def blend_normals(
    normals: Sequence[FloatArray | None], surfaces: FloatArray, surface: FloatArray, weights: FloatArray
) -> FloatArray | None:
    """(m, 3) unit normals of a blended surface; None where no source has normals.

    The surface's own normals, plus the weighted mean of what each source's authored normals add to those of its own
    surface: normals that follow the surface go on to do so, and what was put in by hand stays. A source without normals
    adds nothing.

    :param normals: (m, 3) of every source, any length, or None
    :param surfaces: (K, m, 3) unit normals of the sources' surfaces at the same rows
    :param surface: (m, 3) unit normals of the blended surface
    :param weights: (m, K) shares of every row
    """
    if all(authored is None for authored in normals):
        return None
    blended = np.array(surface, dtype=np.float64)
    for k, authored in enumerate(normals):
        if authored is not None:
            vectors = np.asarray(authored, dtype=np.float64)
            # an authored normal of length 0 says nothing: by its share it would take the own surface's normal away
            share = np.where(np.linalg.norm(vectors, axis=1) > 0, weights[:, k], 0.0)
            blended += share[:, None] * (unit_vectors(vectors) - surfaces[k])
    flat = np.linalg.norm(blended, axis=1) <= _DEGENERATE
    blended[flat] = surface[flat]
    return unit_vectors(blended)


def normal_offsets(
    points: FloatArray, deformed: FloatArray, triangles: IntArray, point_indices: IntArray
) -> FloatArray:
    """(k, 3) differences of the unit normals of deformed and neutral points (n, 3), area-weighted, at some points.

    :param triangles: (t, 3) points
    :param point_indices: (k,)
    """
    touched = np.zeros(len(points), dtype=bool)
    touched[point_indices] = True
    near = triangles[touched[triangles].any(axis=1)]  # all that the normals asked for depend on
    difference = point_normals(deformed, near)[point_indices] - point_normals(points, near)[point_indices]
    return np.asarray(difference)
