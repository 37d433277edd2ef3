"""A head with a mouth that triangles seal, opened along the line between the lips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.parts import Blendshape, FaceParts, Landmarks, Mesh
from facepipe.scanning.transfer.finish import mouth_is_sealed
from facepipe.scanning.transfer.head import Head
from facepipe.scanning.transfer.mouth import cut_mouth
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME
from facepipe.verbs.whole_faces import to_millimetres

_LOWER = (55, 56, 57, 58, 59, 65, 66, 67)  # of multipie68
_WIDTH_MM = 50.0  # of a mouth: what lengths of the cut are of
_APART = 2e-4  # of the mouth's width, between the lips: points at one place would be taken for a seam


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
    lower = np.array(_LOWER)[np.isin(indices[list(_LOWER)], originals)]
    indices[lower] = count + np.searchsorted(originals, indices[lower])
    return replace(marks, indices=indices)
