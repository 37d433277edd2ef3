"""Vertices of one primitive: points split where UVs or normals have seams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import triangulate
from facepipe.parts import Mesh


@dataclass(frozen=True)
class Corners:
    """The corners of all triangles of a mesh: which point, UV and normal each one has."""

    point_count: int
    faces: IntArray  # (t,) the face of each triangle
    points: IntArray  # (t, 3)
    uv_indices: tuple[IntArray, ...]  # per UV set (t, 3) into its values
    uvs: tuple[FloatArray, ...]  # per UV set (u, 2) float32, v down
    normal_indices: IntArray | None  # (t, 3) into normals
    normals: FloatArray | None  # (m, 3) float32 face-varying normals as authored


def corners_of(mesh: Mesh, mirrored: bool) -> Corners:
    """Corners of the triangulated faces, without triangles that use a point twice.

    `mirrored` turns every triangle round, for points that a reflection has moved.
    """
    triangles = triangulate(mesh.face_vertex_counts)
    faces, corners = triangles.faces, triangles.corners
    if mirrored:
        corners = np.ascontiguousarray(corners[:, ::-1])
    points = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
    a, b, c = points.T
    # by points, not by area: a flat triangle of three points may open in a shape
    solid = (a != b) & (b != c) & (c != a)
    if not solid.all():
        faces, corners, points = faces[solid], corners[solid], points[solid]
    uv_indices = tuple(
        points if uv_set.indices is None else np.asarray(uv_set.indices, dtype=np.int64)[corners]
        for uv_set in mesh.uv_sets
    )
    uvs = tuple(_v_down(uv_set.values) for uv_set in mesh.uv_sets)
    normals = normal_indices = None
    if mesh.normals is not None and len(mesh.normals) == len(mesh.face_vertex_indices) != len(mesh.points):
        normals, normal_indices = _plain_zeros(np.asarray(mesh.normals, dtype=np.float32)), corners
    return Corners(len(mesh.points), faces, points, uv_indices, uvs, normal_indices, normals)


@dataclass(frozen=True)
class Vertices:
    """The vertices (v) and triangles (t, 3) of one primitive, in the order of their points."""

    points: IntArray  # (v,) ascending
    uv_indices: tuple[IntArray, ...]  # per UV set (v,)
    normal_indices: IntArray | None  # (v,)
    triangles: IntArray  # (t, 3)
    starts: IntArray  # (n + 1,) first vertex of every point of the mesh, and the end


class _Attribute(NamedTuple):
    """An attribute that may split a point: an index into values (u, columns) at every corner."""

    indices: IntArray  # (c,)
    values: FloatArray


def vertices_of(corners: Corners, chosen: IntArray, extra: IntArray | None = None) -> Vertices:
    """Vertices of the `chosen` triangles: one per distinct point, UVs, normal and `extra` (t,) triangle number.

    Vertices of one point are in the order of the values that make them differ.
    """
    points = corners.points[chosen].ravel()
    pairs = list(zip(corners.uv_indices, corners.uvs, strict=True))
    if corners.normal_indices is not None and corners.normals is not None:
        pairs.append((corners.normal_indices, corners.normals))
    attributes = [_Attribute(indices[chosen].ravel(), values) for indices, values in pairs]
    if extra is not None:
        attributes.append(_Attribute(np.repeat(extra, 3), np.arange(2, dtype=np.float32)[:, None]))
    first = np.full(corners.point_count, -1, np.int64)  # a corner of each point
    first[points] = np.arange(len(points))
    # most points are one vertex: only corners of points that have several values are sorted by these
    seams = _seam_corners(points, first, attributes)
    of_seam, seam_corners = _distinct(
        points[seams], [_Attribute(attribute.indices[seams], attribute.values) for attribute in attributes]
    )
    counts = (first >= 0).astype(np.int64)
    on_seam = points[seams[seam_corners]]  # the point of each vertex at a seam
    counts[on_seam] = 0
    counts += np.bincount(on_seam, minlength=len(counts))
    starts = np.concatenate([[0], np.cumsum(counts)])
    corner = np.empty(starts[-1], np.int64)  # one that each vertex stands for
    used = np.flatnonzero(counts)
    corner[starts[used]] = first[used]
    numbers = starts[on_seam] + np.arange(len(on_seam)) - np.searchsorted(on_seam, on_seam)
    corner[numbers] = seams[seam_corners]
    triangles = starts[points]
    triangles[seams] = numbers[of_seam]
    return Vertices(
        points=points[corner],
        uv_indices=tuple(attribute.indices[corner] for attribute in attributes[: len(corners.uvs)]),
        normal_indices=None if corners.normals is None else attributes[len(corners.uvs)].indices[corner],
        triangles=triangles.reshape(-1, 3),
        starts=starts,
    )


def _seam_corners(points: IntArray, first: IntArray, attributes: Sequence[_Attribute]) -> IntArray:
    """The corners of all points whose corners don't agree."""
    split = np.zeros(len(first), np.bool_)
    reference = first[points]
    for indices, values in attributes:
        other = np.flatnonzero(indices != indices[reference])
        unlike = (values[indices[other]] != values[indices[reference[other]]]).any(axis=1)
        split[points[other[unlike]]] = True
    return np.flatnonzero(split[points])


def _distinct(points: IntArray, attributes: Sequence[_Attribute]) -> tuple[IntArray, IntArray]:
    """The number (c,) of the vertex that each corner becomes, and a corner of each vertex, in the order of points."""
    keys = [points, *(column for indices, values in attributes for column in values[indices].T)]
    order = np.lexsort(keys[::-1])
    changes = np.zeros(len(points), np.bool_)
    changes[:1] = True
    for key in keys:
        ordered = key[order]
        changes[1:] |= ordered[1:] != ordered[:-1]
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(changes) - 1
    return numbers, order[changes]


def _v_down(values: FloatArray) -> FloatArray:
    u, v = np.asarray(values, dtype=np.float64).reshape(-1, 2).T
    return _plain_zeros(np.stack([u, 1.0 - v], axis=1).astype(np.float32))


def _plain_zeros(values: FloatArray) -> FloatArray:
    """float32 `values` without negative zeros."""
    return np.asarray(values + np.float32(0))
