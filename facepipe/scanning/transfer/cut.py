"""A mouth that triangles seal, opened along the line between the lips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.polygons import components
from facepipe.parts import Blendshape, FaceParts, Landmarks, Mesh
from facepipe.scanning.transfer.head import Head
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME
from facepipe.verbs.whole_faces import to_millimetres

_LINE = ((60,), (61, 67), (62, 66), (63, 65), (64,))  # of multipie68, from corner to corner
_LOWER = (55, 56, 57, 58, 59, 65, 66, 67)
_OFF = 4.0  # times its own length that an edge costs for each of its lengths that it lies beside the line
_APART = 2e-4  # of the mouth's width, between the lips: points at one place would be taken for a seam
_FAR = 0.12  # of the mouth's width: a path that leaves the line by more is not one between lips


def cut_mouth(head: Head) -> FaceParts:
    """The head with a slit from corner to corner of its mouth, along edges of its own faces.

    Points of the slit are there twice, the copies after all others; what is known by point is known of both. The
    path is the shortest along edges where one beside the line of the landmarks counts as longer.

    :raises FitError: lips that can't be found, or no path of edges between them
    """
    where, marks = f"{head.where} -> mouth", head.landmarks.points
    if not np.isfinite(marks[[60, *range(61, 68)]]).all():
        raise FitError(where, "landmarks of the lips are unknown, expected them where the mouth is to be cut")
    line = np.stack([marks[list(some)].mean(axis=0) for some in _LINE])
    width = float(np.linalg.norm(line[-1] - line[0]))
    path = _path(head, line, width, where)
    return _opened(head, path, _APART * width, where)


def _path(head: Head, line: FloatArray, width: float, where: str) -> IntArray:
    """Sewn points from the right corner of the mouth to the left one, along edges of polygons."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    surface, skin = head.surface, head.skin()
    rows = np.full(len(surface.points), -1)
    rows[skin] = np.arange(len(skin))
    ends = rows[surface.edges]
    ends = ends[(ends >= 0).all(axis=1)]
    points = head.sewn[skin]
    middles = points[ends].mean(axis=1)
    beside = _distances(middles, line)
    lengths = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    near = beside < 3 * _FAR * width
    ends, lengths, beside = ends[near], lengths[near], beside[near]
    cost = lengths * (1.0 + _OFF * beside / np.maximum(lengths, 1e-9 * width))
    graph = csr_array((cost, (ends[:, 0], ends[:, 1])), shape=(len(points), len(points)))
    used = np.unique(ends)
    if not len(used):
        raise FitError(where, "no edges between the lips, expected a surface there")
    start, end = (int(used[cKDTree(points[used]).query(line[one])[1]]) for one in (0, -1))
    reached, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    if start == end or not np.isfinite(reached[end]):
        raise FitError(where, "no path of edges from corner to corner, expected a finer mesh")
    path = [end]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    found = np.array(path[::-1])
    if len(found) < 3 or _distances(points[found], line).max() > _FAR * width:
        raise FitError(where, "edges leave the line between the lips, expected a finer mesh, or edges along it")
    return np.asarray(skin[found])


def _distances(points: FloatArray, line: FloatArray) -> FloatArray:
    """(n,) of points (n, 3) from a line of k places (k, 3)."""
    starts, steps = line[:-1], np.diff(line, axis=0)
    away = points[:, None] - starts
    shares = np.clip((away * steps).sum(axis=2) / np.maximum((steps * steps).sum(axis=1), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(away - shares[..., None] * steps, axis=2).min(axis=1))


def _opened(head: Head, path: IntArray, apart: float, where: str) -> FaceParts:
    """The head with the inner points of a path doubled: faces below it have the copies."""
    surface, start = head.surface, 0
    inner, meshes = path[1:-1], []
    order = np.full(len(surface.points), -1)
    order[path] = np.arange(len(path))
    up = _up(head)
    for mesh, to in zip(head.parts.meshes, to_millimetres(head.parts), strict=True):
        group = surface.group[start : start + len(mesh.points)]
        start += len(mesh.points)
        corners = group[mesh.face_vertex_indices]
        if not np.isin(corners, inner).any():
            meshes.append(mesh)
            continue
        lift = np.linalg.inv(to)[:3, :3] @ (apart * up)
        below = _below(mesh, corners, order, inner, lift, where)
        meshes.append(_doubled(mesh, below, lift, np.isin(group, inner)))
    return replace(head.parts, meshes=tuple(meshes))


def _up(head: Head) -> FloatArray:
    """(3,) unit, from the lower lip to the nose."""
    marks = head.landmarks.points
    up = np.nanmean(marks[27:36], axis=0) - np.nanmean(marks[55:60], axis=0)
    return np.asarray(up / np.linalg.norm(up))


def _below(mesh: Mesh, corners: IntArray, order: IntArray, inner: IntArray, up: FloatArray, where: str) -> IntArray:
    """Face corners that are at inner points of the path and in a face below it.

    Around each inner point its faces are two fans, on either side of the path. Seen from outside, a face lies to the
    left of its edges, and the path runs from the person's right to the left: the fan above has an edge along the path,
    the one below an edge against it. Of faces that wind the other way it is the reverse, as their middles show.

    :param corners: (c,) sewn points of the mesh's face corners
    :param order: (m,) place of each sewn point on the path, -1 off it
    :param up: (3,) in the space of the mesh
    """
    counts = np.asarray(mesh.face_vertex_counts, np.int64)
    counts = counts[counts > 0]
    ends = np.cumsum(counts)
    following, leading = np.arange(1, len(corners) + 1), np.arange(-1, len(corners) - 1)
    following[ends - 1], leading[ends - counts] = ends - counts, ends - 1
    sides: tuple[list[int], list[int]] = ([], [])
    for point in inner:
        own, here = np.flatnonzero(corners == point), order[point]
        after, before = corners[following[own]], corners[leading[own]]
        spokes: dict[int, list[int]] = {}
        for row, both in enumerate(zip(after.tolist(), before.tolist(), strict=True)):
            for one in both:
                if order[one] not in (here - 1, here + 1) or order[one] < 0:
                    spokes.setdefault(one, []).append(row)
        pairs = [(rows[0], other) for rows in spokes.values() for other in rows[1:]]
        fans = components(len(own), np.array(pairs, np.int64).reshape(-1, 2))
        along = (order[after] == here + 1) | ((order[before] == here - 1) & (order[before] >= 0))
        against = ((order[after] == here - 1) & (order[after] >= 0)) | (order[before] == here + 1)
        if np.intersect1d(fans[along], fans[against]).size:
            raise FitError(where, f"faces around point {mesh.face_vertex_indices[own[0]]} are not two sides of a line")
        for side, chosen in zip(sides, (along, against), strict=True):
            side += own[np.isin(fans, fans[chosen])].tolist()
    of_corner = np.repeat(np.arange(len(counts)), counts)
    middles = (
        np.add.reduceat(np.asarray(mesh.points, np.float64)[mesh.face_vertex_indices] @ up, ends - counts) / counts
    )
    heights = [middles[of_corner[side]].mean() if side else np.nan for side in sides]
    return np.array(sorted(sides[0] if heights[0] < heights[1] else sides[1]), np.int64)


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
    lower = np.array(_LOWER)[np.isin(indices[list(_LOWER)], originals)]
    indices[lower] = count + np.searchsorted(originals, indices[lower])
    return replace(marks, indices=indices)
