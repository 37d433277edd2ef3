"""Normals of several sources blended, and normal offsets of shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from facepipe.geometry.polygons import point_normals

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_DEGENERATE = 1e-6  # a sum of unit vectors shorter than this has no direction


def blend_normals(normals: Sequence[FloatArray | None], weights: FloatArray) -> FloatArray | None:
    """(m, 3) unit normals: weighted means of unit normals, normalised; None where no source has normals.

    Sources without normals leave their share to the others. Where the mean has no direction, the normal is that of
    the source with the largest share, the first of these.

    :param normals: (m, 3) of every source, or None; any length
    :param weights: (m, K) shares of every row
    """
    given = [k for k, one in enumerate(normals) if one is not None]
    if not given:
        return None
    units = np.stack([_unit(np.asarray(normals[k], dtype=np.float64)) for k in given])
    shares = np.asarray(weights, dtype=np.float64)[:, given]
    shares = np.where(shares.sum(axis=1, keepdims=True) > 0, shares, 1.0)  # all of it with sources that have none
    mean = np.einsum("mk,kmc->mc", shares, units)
    flat = np.linalg.norm(mean, axis=1) <= _DEGENERATE * shares.sum(axis=1)
    mean[flat] = units[np.argmax(shares, axis=1), np.arange(len(shares))][flat]
    return _unit(mean)


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


def _unit(vectors: FloatArray) -> FloatArray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))
