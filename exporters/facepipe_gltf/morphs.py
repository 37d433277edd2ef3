"""Morph targets of a mesh in one table: each step is one pass over all targets instead of one per target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.parts import FloatArray, IntArray
from facepipe_gltf.encoding import Encoded
from facepipe_gltf.placement import Placement
from facepipe_gltf.sculpts import Sculpt
from facepipe_gltf.vertices import Vertices


class Morphs(NamedTuple):
    """The offsets of all targets of a mesh, one target after another; float64, metres, Y up."""

    starts: IntArray  # (targets + 1,) first row of each target, and the end
    points: IntArray  # (k,) ascending within a target
    offsets: FloatArray  # (k, 3)
    normal_offsets: FloatArray | None  # (k, 3), zero for targets without; None: no target has any


class Table(NamedTuple):
    """One attribute of all targets as it is stored, without the rows that are zero."""

    starts: IntArray  # (targets + 1,)
    points: IntArray  # (k,)
    values: npt.NDArray[Any]  # (k, 3)
    normalized: bool


class Extent(NamedTuple):
    """Smallest and largest value per axis."""

    low: list[float]
    high: list[float]


class Rows(NamedTuple):
    """One attribute of one target of a primitive: zero but at some vertices."""

    vertices: IntArray  # (k,) ascending
    values: npt.NDArray[Any]  # (k, 3)
    extent: Extent  # of all vertices, those that stay zero too
    normalized: bool


def morphs_of(sculpts: Sequence[Sculpt], placement: Placement, normals: FloatArray) -> Morphs:
    """The table of a mesh's sculpts in glTF space.

    :param normals: (n, 3) unit normals of the mesh's points in glTF space
    """
    starts = np.cumsum([0, *(len(one.point_indices) for one in sculpts)])
    points = _joined([one.point_indices for one in sculpts], np.zeros(0, np.int32)).astype(np.int64)
    empty = np.zeros((0, 3), np.float32)
    offsets = placement.offsets(_joined([one.offsets for one in sculpts], empty), points)
    if all(one.normal_offsets is None for one in sculpts):
        return Morphs(starts, points, offsets, None)
    own = [np.zeros_like(one.offsets) if one.normal_offsets is None else one.normal_offsets for one in sculpts]
    return Morphs(starts, points, offsets, placement.normal_offsets(_joined(own, empty), normals[points], points))


def table_of(morphs: Morphs, encoded: Encoded) -> Table:
    """The rows (k, 3) of `encoded` that are not zero."""
    x, y, z = encoded.array.T
    moving = (x != 0) | (y != 0) | (z != 0)
    if moving.all():
        return Table(morphs.starts, morphs.points, encoded.array, encoded.normalized)
    kept = np.flatnonzero(moving)
    return Table(
        np.searchsorted(kept, morphs.starts), morphs.points[kept], encoded.array.take(kept, axis=0), encoded.normalized
    )


def rows_of(table: Table, vertices: Vertices) -> list[Rows]:
    """What each target does to the vertices of one primitive."""
    per_point = np.diff(vertices.starts)
    copies = per_point[table.points]  # vertices that each row of the table becomes
    moved, values, starts = vertices.starts[table.points], table.values, table.starts
    if len(copies) and not (copies.min() == copies.max() == 1):
        ends = np.concatenate([[0], np.cumsum(copies)])
        source = np.repeat(np.arange(len(copies)), copies)
        moved = (moved - ends[:-1])[source] + np.arange(len(source))
        values, starts = values.take(source, axis=0), ends[starts]
    extents = _extents(values, starts, len(vertices.points))
    bounds = zip(starts[:-1].tolist(), starts[1:].tolist(), extents, strict=True)
    return [Rows(moved[a:b], values[a:b], extent, table.normalized) for a, b, extent in bounds]


def _extents(values: npt.NDArray[Any], starts: IntArray, count: int) -> list[Extent]:
    """Per target, of all its `count` vertices."""
    sizes = np.diff(starts)
    filled = np.flatnonzero(sizes)
    low = np.zeros((len(sizes), 3), values.dtype)
    high = np.zeros((len(sizes), 3), values.dtype)
    if len(filled):
        axes = np.ascontiguousarray(values.T)
        low[filled] = np.minimum.reduceat(axes, starts[filled], axis=1).T
        high[filled] = np.maximum.reduceat(axes, starts[filled], axis=1).T
    partial = sizes < count
    low[partial] = np.minimum(low[partial], 0)
    high[partial] = np.maximum(high[partial], 0)
    return [Extent(*pair) for pair in zip(low.tolist(), high.tolist(), strict=True)]


def _joined(arrays: Sequence[npt.NDArray[Any]], empty: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.concatenate(arrays) if arrays else empty
