"""Polygon meshes as counts and indices: triangles, normals, components, borders."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


class Triangles(NamedTuple):
    """A triangulation: corner numbers (t, 3) into the face-vertex list, and the face (t,) of every triangle."""

    corners: IntArray
    faces: IntArray


def triangulate(face_vertex_counts: IntArray) -> Triangles:
    """Fan triangulation of every polygon; faces with fewer than 3 corners give none.

    Point indices are ``face_vertex_indices[triangulate(counts).corners]``.
    """
    counts = np.asarray(face_vertex_counts, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else np.zeros(0, np.int64)
    fans = np.maximum(counts - 2, 0)
    faces = np.repeat(np.arange(len(counts)), fans)
    step = np.arange(len(faces)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[faces]
    return Triangles(np.stack([first, first + step + 1, first + step + 2], axis=1), faces)


def point_triangles(face_vertex_counts: IntArray, face_vertex_indices: IntArray) -> IntArray:
    """(t, 3) point indices of the fan triangulation."""
    return np.asarray(face_vertex_indices)[triangulate(face_vertex_counts).corners]


def point_normals(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(n, 3) unit normals, area-weighted over the triangles at each point; (0, 1, 0) where there is none."""
    a, b, c = triangles.T
    columns = np.ascontiguousarray(np.asarray(points, dtype=np.float64).T)  # axis by axis: much faster than np.cross
    ux, uy, uz = (axis[b] - axis[a] for axis in columns)
    vx, vy, vz = (axis[c] - axis[a] for axis in columns)
    areas = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
    corners = triangles.ravel()
    summed = np.stack([np.bincount(corners, np.repeat(area, 3), minlength=len(points)) for area in areas], axis=1)
    length = np.sqrt(sum(axis * axis for axis in summed.T))[:, None]
    flat = length[:, 0] < np.finfo(np.float64).tiny
    summed[flat] = (0.0, 1.0, 0.0)
    length[flat] = 1.0
    return np.asarray(summed / length)


def point_areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(n,) a third of the area of the triangles (t, 3) at each point."""
    corners = np.asarray(points, dtype=np.float64)[triangles]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.asarray(np.bincount(triangles.ravel(), np.repeat(doubled / 6.0, 3), minlength=len(points)), np.float64)


def edges(face_vertex_counts: IntArray, face_vertex_indices: IntArray) -> tuple[IntArray, IntArray]:
    """Undirected edges (e, 2), lower point first, sorted, and the number of faces (e,) at each."""
    counts = np.asarray(face_vertex_counts, dtype=np.int64)
    indices = np.asarray(face_vertex_indices, dtype=np.int64)
    ends = np.cumsum(counts)
    following = np.arange(1, len(indices) + 1)
    following[ends[counts > 0] - 1] = (ends - counts)[counts > 0]
    others = indices[following]
    low = int(indices.min(initial=0))
    span = int(indices.max(initial=0)) - low + 1
    # one number a pair: twenty times as fast as np.unique of rows
    keys = (np.minimum(indices, others) - low) * span + np.maximum(indices, others) - low
    unique, faces = np.unique(keys, return_counts=True)
    return np.stack(np.divmod(unique, span), axis=1) + low, faces


def components(point_count: int, edge_pairs: IntArray) -> IntArray:
    """(n,) component number of every point, connected through `edge_pairs` (e, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(edge_pairs), dtype=np.int8)
    edge_pairs = np.asarray(edge_pairs, dtype=np.int32)  # older scipy takes no 64-bit indices here
    graph = coo_array((ones, (edge_pairs[:, 0], edge_pairs[:, 1])), shape=(point_count, point_count))
    return np.asarray(connected_components(graph, directed=False)[1])
