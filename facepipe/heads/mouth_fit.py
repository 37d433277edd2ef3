"""The inside of a mouth, kept behind the skin: identity modes move it, lips and cheeks each in their own way."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads.asset import asset

_SKIN, _INSIDE = 9409, slice(11248, 13294)  # points of the face before these; points of the mouth's inside
_LIPS = 0.15  # cm; what lies less deep belongs to the lips
_LEAST = 0.5  # of its depth in the average head that a point keeps
_NEAREST = 8  # points of the skin that it is kept behind


def fit_mouth(points: FloatArray) -> FloatArray:
    """The (n, 3) points of a head with the mouth's inside half as deep at least as it is in the average head."""
    inside, skin, least = _pairs()
    normals = point_normals(points[:_SKIN], _triangles())[skin]
    depths = ((points[skin] - points[inside, None]) * normals).sum(axis=-1)
    missing = np.maximum(least - depths, 0.0)
    most = missing.argmax(axis=1)
    rows = np.arange(len(inside))
    fitted = points.copy()
    fitted[inside] -= missing[rows, most, None] * normals[rows, most]
    return fitted


@cache
def _pairs() -> tuple[IntArray, IntArray, FloatArray]:
    """(k,) points of the mouth's inside, (k, 8) the points of the skin before them, and how deep they have to lie."""
    points = asset().points
    inside = np.arange(_INSIDE.start, _INSIDE.stop)
    skin = cKDTree(points[:_SKIN]).query(points[inside], _NEAREST)[1]
    normals = point_normals(points[:_SKIN], _triangles())[skin]
    depths = ((points[skin] - points[inside, None]) * normals).sum(axis=-1)
    deep = depths.min(axis=1) > _LIPS
    return inside[deep], skin[deep], _LEAST * depths[deep]


@cache
def _triangles() -> IntArray:
    triangles = point_triangles(asset().counts, asset().indices)
    return triangles[(triangles < _SKIN).all(axis=1)]
