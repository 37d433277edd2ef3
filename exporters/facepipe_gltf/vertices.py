"""Vertices of one primitive: points split where UVs or normals have seams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.geometry.polygons import triangulate
from facepipe.parts import FloatArray, IntArray, Mesh


@dataclass(frozen=True)
class Corners:
    """The corners of all triangles of a mesh: which point, UV and normal each one has."""

    faces: IntArray  # (t,) the face of each triangle
    corners: IntArray  # (t, 3) into the mesh's face-vertex list
    points: IntArray  # (t, 3)
    uv_indices: tuple[IntArray, ...]  # per UV set (t, 3) into its values
    uvs: tuple[FloatArray, ...]  # per UV set (u, 2) float32, v down
    normal_indices: IntArray | None  # (t, 3) into normals
    normals: FloatArray | None  # (m, 3) distinct face-varying normals as authored


def corners_of(mesh: Mesh, mirrored: bool) -> Corners:
    """Corners of the triangulated faces, without triangles that use a point twice.

    `mirrored` turns every triangle round, for points that a reflection has moved.
    """
    triangles = triangulate(mesh.face_vertex_counts)
    corners = triangles.corners[:, ::-1] if mirrored else triangles.corners
    points = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
    a, b, c = points.T
    solid = (a != b) & (b != c) & (c != a)
    faces, corners, points = triangles.faces[solid], corners[solid], points[solid]
    uvs, uv_indices = [], []
    for uv_set in mesh.uv_sets:
        values, welded = _weld(_v_down(uv_set.values))
        uvs.append(values)
        uv_indices.append(welded[points if uv_set.indices is None else np.asarray(uv_set.indices)[corners]])
    normals = normal_indices = None
    if mesh.normals is not None and len(mesh.normals) == len(mesh.face_vertex_indices) != len(mesh.points):
        normals, welded = _weld(np.asarray(mesh.normals, dtype=np.float32))
        normal_indices = welded[corners]
    return Corners(faces, corners, points, tuple(uv_indices), tuple(uvs), normal_indices, normals)


@dataclass(frozen=True)
class Vertices:
    """The vertices (v) and triangles (t, 3) of one primitive, in the order of their points."""

    points: IntArray  # (v,)
    uv_indices: tuple[IntArray, ...]  # per UV set (v,)
    normal_indices: IntArray | None  # (v,)
    triangles: IntArray  # (t, 3)


def vertices_of(corners: Corners, chosen: IntArray, extra: IntArray | None = None) -> Vertices:
    """Vertices of the `chosen` triangles: one per distinct point, UVs, normal and `extra` (t,) triangle number."""
    keys = [corners.points[chosen].ravel(), *(indices[chosen].ravel() for indices in corners.uv_indices)]
    if corners.normal_indices is not None:
        keys.append(corners.normal_indices[chosen].ravel())
    if extra is not None:
        keys.append(np.repeat(extra, 3))
    key = keys[0]
    for following in keys[1:]:
        span = int(following.max(initial=0)) + 1
        key = key * span + following
        if key.max(initial=0) > 1 << 40:  # keep the products of several sets far from overflow
            key = np.unique(key, return_inverse=True)[1]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return Vertices(
        points=keys[0][first],
        uv_indices=tuple(indices[chosen].ravel()[first] for indices in corners.uv_indices),
        normal_indices=None if corners.normal_indices is None else corners.normal_indices[chosen].ravel()[first],
        triangles=inverse.reshape(-1, 3),
    )


def _v_down(values: FloatArray) -> FloatArray:
    u, v = np.asarray(values, dtype=np.float64).reshape(-1, 2).T
    return np.stack([u, 1.0 - v], axis=1).astype(np.float32)


def _weld(values: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distinct rows of float32 `values`, and the row that each one became."""
    rows = np.ascontiguousarray(values + np.float32(0))  # no negative zeros
    bits = rows.view(np.uint32).astype(np.int64)
    key = bits[:, 0] << 32 | bits[:, 1]
    for column in bits.T[2:]:
        key = np.unique(key, return_inverse=True)[1] << 32 | column
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return rows[first], inverse
