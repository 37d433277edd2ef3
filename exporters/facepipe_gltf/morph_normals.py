"""Normals of morph targets that have none of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals
from facepipe_gltf.sculpts import Sculpt

_SAME = 1e-6  # smaller changes of a unit normal don't show


def with_normals(sculpts: Sequence[Sculpt], points: FloatArray, triangles: IntArray) -> list[Sculpt]:
    """The sculpts with normal offsets: authored ones stay, others are how the smooth normals of the surface change.

    :param points: (n, 3) of the mesh, in its own space as the sculpts are; `triangles` (t, 3) as authored
    """
    neutral = np.asarray(points, dtype=np.float64)
    normals = point_normals(neutral, triangles)
    return [one if one.normal_offsets is not None else _computed(one, neutral, normals, triangles) for one in sculpts]


def _computed(sculpt: Sculpt, neutral: FloatArray, normals: FloatArray, triangles: IntArray) -> Sculpt:
    offsets = np.zeros_like(neutral)
    offsets[sculpt.point_indices] = sculpt.offsets
    moved = np.zeros(len(neutral), np.bool_)
    moved[sculpt.point_indices] = True
    turned = moved.copy()  # the neighbours of moved points turn too
    turned[triangles[_touching(triangles, moved)]] = True
    rows = np.flatnonzero(turned)
    change = (point_normals(neutral + offsets, triangles[_touching(triangles, turned)]) - normals)[rows]
    x, y, z = np.abs(change).T
    same = (x < _SAME) & (y < _SAME) & (z < _SAME)
    change[same] = 0.0
    kept = ~same | moved[rows]
    return replace(sculpt, point_indices=rows[kept], offsets=offsets[rows[kept]], normal_offsets=change[kept])


def _touching(triangles: IntArray, points: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(t,) triangles that have one of the flagged points."""
    a, b, c = triangles.T
    return np.asarray(points[a] | points[b] | points[c])
