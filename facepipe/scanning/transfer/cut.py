"""A head with a mouth that triangles seal, opened along the line between the lips."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.polygons import components, distinct_edges
from facepipe.parts import Blendshape, FaceParts, Landmarks, Mesh
from facepipe.scanning.transfer.finish import mouth_is_sealed
from facepipe.scanning.transfer.head import Head
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME
from facepipe.verbs.whole_faces import to_millimetres

_LOWER_LIP = (55, 56, 57, 58, 59, 65, 66, 67)  # of multipie68
_WIDTH_MM = 50.0  # of a mouth: what lengths of the cut are of
_APART = 2e-4  # of the mouth's width, between the lips: points at one place would be taken for a seam
_UPPER_RIM, _LOWER_RIM = (
    [60, 61, 62, 63, 64],
    [60, 67, 66, 65, 64],
)  # landmarks of the lips' inner rims, corner to corner
_DRAWN_MM = 1.5  # from the line of the lips, at which an edge counts as twice as long
_ACROSS = 3.0  # times as long counts an edge straight across
_NEAR = 0.75  # of the mouth's width from its middle: points that the cut may go by
_STRAIGHT = 1.6  # times the mouth's width, up to which a way is along the lips


def with_cut_mouth(head: Head) -> FaceParts:
    """The head with a slit from corner to corner of its mouth, along edges of its own faces.

    Points of the slit are there twice, the copies after all others; what is known by point is known of both.

    :raises FitError: lips that can't be found, or no path of edges between them
    """
    where, marks = f"{head.where} -> mouth", head.landmarks.points
    if not np.isfinite(marks[[*range(27, 36), *range(48, 68)]]).all():
        raise FitError(where, "landmarks of nose and lips are unknown, expected them where the mouth is to be cut")
    width = float(np.linalg.norm(marks[64] - marks[60]))
    counts = np.concatenate([mesh.face_vertex_counts for mesh in head.parts.meshes])
    starts = np.cumsum([0, *(len(mesh.points) for mesh in head.parts.meshes)])
    corners = np.concatenate(
        [
            head.surface.group[start + mesh.face_vertex_indices]
            for start, mesh in zip(starts, head.parts.meshes, strict=False)
        ]
    )
    scale = _WIDTH_MM / width
    lips, skin = marks[48:68], head.skin()
    if np.isfinite(lips).all() and not mouth_is_sealed(
        head.sewn[skin] * scale, head.surface.part_triangles(skin), marks * scale
    ):
        raise FitError(where, "the lips are open already, expected a mouth that triangles seal for --cut-mouth")
    try:
        cut = cut_mouth(head.sewn * scale, counts, corners, marks * scale)
    except FitError as error:
        raise error.under(head.where) from None
    up = marks[27:36].mean(axis=0) - marks[55:60].mean(axis=0)
    up *= _APART * width / np.linalg.norm(up)
    below = np.split(
        cut.indices >= len(head.sewn), np.cumsum([len(mesh.face_vertex_indices) for mesh in head.parts.meshes])[:-1]
    )
    on_line = np.split(np.isin(head.surface.group, cut.line[1:-1]), starts[1:-1])
    meshes = [
        _doubled(mesh, np.flatnonzero(low), np.linalg.inv(to)[:3, :3] @ up, on) if low.any() else mesh
        for mesh, low, on, to in zip(head.parts.meshes, below, on_line, to_millimetres(head.parts), strict=True)
    ]
    return replace(head.parts, meshes=tuple(meshes))


def _doubled(mesh: Mesh, below: IntArray, lift: FloatArray, on_path: BoolArray) -> Mesh:
    """The mesh with copies of the points at corners `below`, half of `lift` (3,) under the path as those above it are
    over it: at one place they would be taken for a seam.

    :param on_path: (n,) points that are at inner points of the path
    """
    originals, of_corner = np.unique(mesh.face_vertex_indices[below], return_inverse=True)
    count = len(mesh.points)
    indices = np.array(mesh.face_vertex_indices)
    indices[below] = count + of_corner
    rows = np.concatenate([np.arange(count), originals])
    points = np.asarray(mesh.points, np.float64)[rows]
    points[:count][on_path] += lift / 2
    points[count:] -= lift / 2

    normals = mesh.normals
    skin = mesh.skin
    if skin is not None:
        skin = replace(skin, joint_indices=skin.joint_indices[rows], joint_weights=skin.joint_weights[rows])
    return replace(
        mesh,
        points=points,
        face_vertex_indices=indices.astype(np.int32),
        normals=normals[rows] if normals is not None and len(normals) == count else normals,
        uv_sets=tuple(uv if uv.indices is not None else replace(uv, values=uv.values[rows]) for uv in mesh.uv_sets),
        colors=None if mesh.colors is None else mesh.colors[rows],
        skin=skin,
        blendshapes=tuple(_shape_doubled(shape, originals, count) for shape in mesh.blendshapes),
        regions={name: mask[rows] for name, mask in mesh.regions.items()},
        point_subsets={
            name: np.concatenate([own, count + np.flatnonzero(np.isin(originals, own))]).astype(np.int32)
            for name, own in mesh.point_subsets.items()
        },
        landmarks={scheme: _lowered(scheme, marks, originals, count) for scheme, marks in mesh.landmarks.items()},
    )


def _shape_doubled(shape: Blendshape, originals: IntArray, count: int) -> Blendshape:
    """The shape with the offsets of the originals on their copies, which follow `count` points."""
    moving = np.flatnonzero(np.isin(originals, shape.point_indices))
    more = np.searchsorted(shape.point_indices, originals[moving])
    rows = np.concatenate([np.arange(len(shape.point_indices)), more])
    indices = np.concatenate([shape.point_indices, count + moving]).astype(np.int32)
    return replace(shape.changed(lambda own: own[rows], lambda own: own[rows]), point_indices=indices)


def _lowered(scheme: str, marks: Landmarks, originals: IntArray, count: int) -> Landmarks:
    """Landmarks of the lower lip on the copies."""
    if scheme != LANDMARK_SCHEME or len(marks.indices) != LANDMARK_COUNT:
        return marks
    indices = np.array(marks.indices)
    lower = np.array(_LOWER_LIP)[np.isin(indices[list(_LOWER_LIP)], originals)]
    indices[lower] = count + np.searchsorted(originals, indices[lower])
    return replace(marks, indices=indices)


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

    rim = (landmarks[_UPPER_RIM] + landmarks[_LOWER_RIM]) / 2.0
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
