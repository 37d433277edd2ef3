"""Polygon meshes as counts and indices: triangles, normals, components, borders, holes, merged points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray

# Twice the area, relative to the square of the longest side, below which the normal is float32 rounding.
_FLAT_HEIGHT = 1e-6


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
    pairs, _, faces = distinct_edges(np.stack([indices, others], axis=1))
    return pairs, faces


def distinct_edges(ends: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Distinct edges (e, 2), lower point first, sorted; the edge (m,) of each of (m, 2) `ends`; their counts (e,)."""
    ends = np.asarray(ends, dtype=np.int64)
    low = int(ends.min(initial=0))
    span = int(ends.max(initial=0)) - low + 1
    # one number a pair: ten times as fast as np.unique of rows (160,000 ends, numpy 2.4)
    keys = (ends.min(axis=1) - low) * span + ends.max(axis=1) - low
    unique, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.stack(np.divmod(unique, span), axis=1) + low, edge, count


def components(point_count: int, edge_pairs: IntArray) -> IntArray:
    """(n,) component number of every point, connected through `edge_pairs` (e, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(edge_pairs), dtype=np.int8)
    edge_pairs = np.asarray(edge_pairs, dtype=np.int32)  # older scipy takes no 64-bit indices here
    graph = coo_array((ones, (edge_pairs[:, 0], edge_pairs[:, 1])), shape=(point_count, point_count))
    return np.asarray(connected_components(graph, directed=False)[1])


def flipped_triangles(before: FloatArray, after: FloatArray, triangles: IntArray) -> BoolArray:
    """(t,) which of `triangles` (t, 3) turn by more than 90 degrees from points `before` (n, 3) to `after` (n, 3).

    Those without area before or after are not counted.
    """
    return turned_triangles(triangle_normals(before, triangles), after, triangles)


def turned_triangles(normals: FloatArray, points: FloatArray, triangles: IntArray) -> BoolArray:
    """(t,) which of `triangles` (t, 3) at `points` (n, 3) face away from the reference `normals` (t, 3).

    The length of the reference normals does not count; those of length 0, and triangles without area, are not counted.
    """
    return np.asarray(np.einsum("ti,ti->t", np.asarray(normals, np.float64), triangle_normals(points, triangles)) < 0)


def triangle_normals(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(t, 3) unit normals; 0 where a triangle has no area."""
    corners = np.asarray(points, np.float64)[triangles]
    sides = corners[:, [1, 2, 0]] - corners
    normals = np.cross(sides[:, 0], sides[:, 1])
    lengths = np.linalg.norm(normals, axis=1)
    longest = np.einsum("tei,tei->te", sides, sides).max(axis=1, initial=0.0)
    solid = lengths > _FLAT_HEIGHT * longest
    normals[~solid] = 0.0
    return np.asarray(normals / np.where(solid, lengths, 1.0)[:, None])


def back_of_border(points: FloatArray, face_vertex_counts: IntArray, face_vertex_indices: IntArray) -> int | None:
    """The point at the back of the open border, nearest to the middle in x; None for a closed mesh.

    Y is up and the face looks along +Z. On a head this is the nape end of the neck border: the anchor.
    """
    pairs, faces = edges(face_vertex_counts, face_vertex_indices)
    border = np.unique(pairs[faces == 1])
    if len(border) == 0:
        return None
    behind = border[points[border, 2] <= np.median(points[border, 2])]
    return int(behind[np.argmin(np.abs(points[behind, 0]))])


def small_holes(points: FloatArray, triangles: IntArray, largest: float) -> list[IntArray]:
    """The border loops of an oriented manifold whose bounding box is at most `largest` along its diagonal.

    Each as the points (k,) around the hole, in the order in which the missing triangles would run.
    """
    following = _border_steps(triangles, len(points))
    loops = []
    for start in list(following):
        loop = []
        at: int | None = start
        while at is not None and at in following:
            loop.append(at)
            at = following.pop(at)
        if loop and at == start:
            corners = points[loop]
            if np.linalg.norm(np.ptp(corners, axis=0)) <= largest:
                loops.append(np.array(loop))
    return loops


def touching(elements: IntArray, points: BoolArray) -> BoolArray:
    """(t,) edges or triangles (t, k) that have a flagged point of (n,); numpy's `any` takes five times as long."""
    found = points.take(elements[:, 0])
    for corner in range(1, elements.shape[1]):
        found |= points.take(elements[:, corner])
    return np.asarray(found)


def border_points(count: int, triangles: IntArray) -> IntArray:
    """The points (b,), of `count`, on edges of one triangle of an oriented manifold."""
    return np.array(sorted(_border_steps(triangles, count)), dtype=np.int64)


def _border_steps(triangles: IntArray, count: int) -> dict[int, int]:
    """The point after each border point, against the triangles' order; one of them where loops touch."""
    start, end = triangles.ravel().astype(np.int64), triangles[:, [1, 2, 0]].ravel().astype(np.int64)
    there, back = start * count + end, np.sort(end * count + start)
    order = np.argsort(there, kind="stable")
    # np.isin hashes both, which takes it 34 s for 6 million triangles, and this 2 s
    at = np.minimum(np.searchsorted(back, there[order]), len(back) - 1)
    alone = np.sort(order[back[at] != there[order]])
    return dict(zip(end[alone].tolist(), start[alone].tolist(), strict=True))


def merge_points(points: FloatArray) -> tuple[IntArray, IntArray]:
    """First point of every place, in their order, and the place (n,) of every point (n, 3). -0 is 0."""
    return distinct_rows(np.asarray(points, dtype=np.float64) + 0.0)


def distinct_rows(rows: FloatArray | IntArray) -> tuple[IntArray, IntArray]:
    """First row of every distinct row of (n, k), in order of appearance, and the group (n,) of each row."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])[: len(rows)]
    first = order[new]  # the sort is stable: the earliest of equal rows
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    group = np.empty(len(rows), np.int64)
    group[order] = rank[np.cumsum(new) - 1]
    return np.sort(first), group


def welded_points(points: FloatArray, border: BoolArray, tolerance: float) -> IntArray:
    """(n,) group of every point (n, 3): border points nearer to each other than `tolerance` are one group.

    Points inside a surface stay apart, wherever they lie: closed lips touch, and are two. Groups are numbered in the
    order of their first points.

    :param border: (n,) whether a point is at an edge that has one face
    """
    from scipy.spatial import cKDTree

    at = np.flatnonzero(border)
    pairs = cKDTree(points[at]).query_pairs(tolerance, output_type="ndarray") if len(at) else np.zeros((0, 2), np.int64)
    groups = components(len(points), at[pairs])
    _, first, place = np.unique(groups, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first, kind="stable"), kind="stable")[place.ravel()])
