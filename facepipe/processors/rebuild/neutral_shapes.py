"""Blendshapes of a mesh on a new neutral: kept ones, and new ones from whole deltas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import Blendshape, Mesh
from facepipe.processors.blend.normals import normal_offsets

STILL_MM = 1e-4  # points that a shape moves by less stay where they are


def mesh_shapes(
    mesh: Mesh, points: FloatArray, deltas: Mapping[str, tuple[FloatArray, bool]], back: FloatArray
) -> tuple[Blendshape, ...]:
    """The shapes of a mesh with new points (n, 3): its own in their order, those in `deltas` anew, then what else is
    in there. Normal offsets are made again where a shape had some, unless `points` are the mesh's own.

    :param deltas: shape -> (n, 3) in millimetres of the world, and whether the mesh must hold it though nothing moves
    :param back: (3, 3) from those to mesh space
    """
    own = {shape.name: shape for shape in mesh.blendshapes}
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    found = []
    for name in dict.fromkeys([*own, *deltas]):
        old = own.get(name)
        if name not in deltas and old is not None:
            found.append(old if points is mesh.points else _kept(old, points, triangles))
            continue
        delta, held = deltas[name]
        with_normals = old is not None and old.normal_offsets is not None
        shape = _new(name, delta, back, triangles if with_normals else None, held=held)
        if shape is not None:
            found.append(_with_normals(shape, points, triangles) if with_normals else shape)
    return tuple(found)


def _kept(shape: Blendshape, points: FloatArray, triangles: IntArray) -> Blendshape:
    """A shape with the same offsets from other points."""
    if shape.normal_offsets is not None:
        shape = _with_normals(shape, points, triangles)
    between = tuple(
        one
        if one.normal_offsets is None
        else replace(one, normal_offsets=_normals(shape.point_indices, one.offsets, points, triangles))
        for one in shape.inbetweens
    )
    return replace(shape, inbetweens=between)


def _new(
    name: str, delta: FloatArray, back: FloatArray, triangles: IntArray | None, *, held: bool
) -> Blendshape | None:
    """A sparse shape; None where nothing moves, unless it is `held`.

    :param triangles: where given, neighbours of points that move are there too: their normals turn
    """
    moving = np.linalg.norm(delta, axis=1) >= STILL_MM
    indices = np.flatnonzero(moving)
    if triangles is not None:
        indices = np.union1d(indices, triangles[moving[triangles].any(axis=1)].ravel())
    if not len(indices):
        if not held:
            return None
        indices = np.zeros(1, np.int64)  # USD reads a shape without indices as one over all points
    offsets = np.where(moving[indices, None], delta[indices], 0.0) @ back.T
    return Blendshape(name=name, point_indices=indices.astype(np.int32), offsets=offsets)


def _with_normals(shape: Blendshape, points: FloatArray, triangles: IntArray) -> Blendshape:
    return replace(shape, normal_offsets=_normals(shape.point_indices, shape.offsets, points, triangles))


def _normals(indices: IntArray, offsets: FloatArray, points: FloatArray, triangles: IntArray) -> FloatArray:
    moved = np.array(points, np.float64)
    moved[indices] += offsets
    return normal_offsets(points, moved, triangles, indices)
