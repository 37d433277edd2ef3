"""Points that no level goes without."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import components, edges
from facepipe.parts import Mesh
from facepipe.rig import Rig

_SPACING = 0.2  # of the size of a line, between points of it that stay: some 12 of a circle


def marks(mesh: Mesh) -> IntArray:
    """Landmarks and anchor of a mesh."""
    anchor = [] if mesh.anchor is None else [mesh.anchor]
    return np.concatenate([*(one.indices for one in mesh.landmarks.values()), anchor]).astype(np.int64)


def strongest(rig: Rig) -> IntArray:
    """The point that each sculpt moves most: no level lacks a shape."""
    moving = [one for one in rig.targets if len(one.offsets)]
    return np.array([one.point_indices[np.linalg.norm(one.offsets, axis=1).argmax()] for one in moving], np.int64)


def even_points(points: FloatArray, triangles: IntArray, rims: IntArray) -> IntArray:
    """Some of the points on each line of `rims`, evenly: the rims of iris and pupil stay round.

    :param points: (n, 3)
    :param triangles: (t, 3)
    :param rims: (r,) ascending
    """
    pairs = edges(np.full(len(triangles), 3), triangles.ravel())[0]
    line = components(len(points), pairs[np.isin(pairs, rims).all(axis=1)])[rims]
    found = [rims[line == number][_apart(points[rims[line == number]])] for number in np.unique(line)]
    return np.concatenate([*found, np.zeros(0, np.int64)])


def _apart(points: FloatArray) -> list[int]:
    """Numbers of points (n, 3) that are some way apart, with none of all farther from every one of them."""
    chosen, away = list[int](), np.full(len(points), np.inf)
    while away.max() > _SPACING * np.ptp(points, axis=0).max():
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
