"""A mouth that triangles seal, cut open along the line of its lips."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.polygons import components, distinct_edges

_UPPER, _LOWER = [60, 61, 62, 63, 64], [60, 67, 66, 65, 64]  # landmarks of the lips' inner rims, corner to corner
_DRAWN_MM = 1.5  # from the line of the lips, at which an edge counts as twice as long
_ACROSS = 3.0  # times as long counts an edge straight across
_NEAR = 0.75  # of the mouth's width from its middle: points that the cut may go by
_STRAIGHT = 1.6  # times the mouth's width, up to which a way is along the lips


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A mesh whose mouth is open: the same faces, some of them at points of their own."""

    source: IntArray  # (n + k,) the point of the whole mesh that each is: what points have is taken from there
    indices: IntArray  # of the faces' corners, in their order
    line: IntArray  # (k + 2,) points from corner to corner


def cut_mouth(
    points: FloatArray, face_vertex_counts: IntArray, face_vertex_indices: IntArray, landmarks: FloatArray
) -> Cut:
    """The mesh cut along its lips, on edges that it has: nothing moves, and attributes of corners stay as they are.

    :param points: (n, 3) mm
    :param landmarks: (68, 3) mm
    :raises FitError: no way along the edges from corner to corner, or one that does not part the skin
    """
    counts, indices = np.asarray(face_vertex_counts, np.int64), np.asarray(face_vertex_indices, np.int64)
    starts = np.cumsum(counts) - counts
    following = np.arange(1, len(indices) + 1)
    following[starts[counts > 0] + counts[counts > 0] - 1] = starts[counts > 0]
    pairs, edge, _ = distinct_edges(np.stack([indices, indices[following]], axis=1))
    line = _lip_line(points, pairs, landmarks)
    inner = np.zeros(len(points), bool)
    inner[line[1:-1]] = True
    # faces at points between the corners, joined over edges that leave the line there: those above, and those below
    on_line = np.sort(np.stack([line[:-1], line[1:]], axis=1), axis=1)
    count = len(points)
    crossing = inner[pairs].any(axis=1) & ~np.isin(pairs @ [count, 1], on_line @ [count, 1])
    face = np.repeat(np.arange(len(counts)), counts)
    at = np.flatnonzero(crossing[edge])
    order = at[np.argsort(edge[at], kind="stable")]
    shared = edge[order[:-1]] == edge[order[1:]]
    joined = np.stack([face[order[:-1]], face[order[1:]]], axis=1)[shared]
    faces = np.unique(face[inner[indices]])
    part = components(len(counts), joined)[faces]
    if len(np.unique(part)) != 2:
        raise FitError(
            "--cut-mouth", "the line of the lips does not part the skin in two, expected a mouth between lips"
        )
    up = _upward(landmarks)
    heights = [
        (points[indices[np.isin(face, faces[part == one]) & ~inner[indices]]] @ up).mean() for one in np.unique(part)
    ]
    below = faces[part == np.unique(part)[int(np.argmin(heights))]]
    new = np.full(count, -1)
    new[line[1:-1]] = count + np.arange(len(line) - 2)
    moved = np.isin(face, below) & inner[indices]
    return Cut(
        source=np.append(np.arange(count), line[1:-1]), indices=np.where(moved, new[indices], indices), line=line
    )


def _upward(landmarks: FloatArray) -> FloatArray:
    """(3,) the unit direction from the lower lip to the upper one, by their outer rims: inner ones may touch."""
    up = landmarks[50:53].mean(axis=0) - landmarks[56:59].mean(axis=0)
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))


def _lip_line(points: FloatArray, pairs: IntArray, landmarks: FloatArray) -> IntArray:
    """Points along edges from corner to corner of the mouth, by the way that is short and near the lips' line."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    rim = (landmarks[_UPPER] + landmarks[_LOWER]) / 2.0
    width = float(np.linalg.norm(rim[-1] - rim[0]))
    dense = np.concatenate([a + np.linspace(0, 1, 20)[:, None] * (b - a) for a, b in pairwise(rim)])
    near = np.linalg.norm(points - rim.mean(axis=0), axis=1) < _NEAR * width
    pairs = pairs[near[pairs].all(axis=1) & (pairs[:, 0] != pairs[:, 1])]
    if not len(pairs):
        raise FitError("--cut-mouth", "no edges at the mouth, expected a mesh of lips")
    lengths = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    away = cKDTree(dense).query(points[pairs].mean(axis=1))[0]
    # edges across, between lips that touch, are short: without a price on them the cut would go to and fro
    across = np.abs((points[pairs[:, 1]] - points[pairs[:, 0]]) @ _upward(landmarks)) / np.maximum(lengths, 1e-12)
    costs = np.maximum(lengths, 1e-9 * width) * (1.0 + (away / _DRAWN_MM) ** 2 + _ACROSS * across)
    ends = [
        int(used[np.linalg.norm(points[used] - end, axis=1).argmin()])
        for used in [np.unique(pairs)]
        for end in rim[[0, -1]]
    ]
    # indices of 32 bits: older SciPy finds no paths by others
    graph = csr_array((costs, tuple(pairs.T.astype(np.int32))), shape=(len(points), len(points)))
    _, before = dijkstra(graph, directed=False, indices=ends[0], return_predecessors=True)
    line = [ends[1]]
    while line[-1] != ends[0] and before[line[-1]] >= 0:
        line.append(int(before[line[-1]]))
    found = np.array(line[::-1])
    long = np.linalg.norm(np.diff(points[found], axis=0), axis=1).sum() > _STRAIGHT * width
    if found[0] != ends[0] or len(found) < 3 or long:
        raise FitError(
            "--cut-mouth", "no edges lead along the lips from corner to corner, expected at least three points"
        )
    return found
