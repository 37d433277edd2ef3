"""A mesh as wedges: one vertex for all corners of a point that share UVs, normal and material."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import triangulate
from facepipe.parts import Blendshape, Landmarks, MaterialFaces, Mesh, Skin, UvSet

_NORMAL_STEPS = 64  # of -1 to 1: corners whose normals differ less are no crease


@dataclass(frozen=True, kw_only=True)
class Wedges:
    """A mesh in wedges."""

    mesh: Mesh
    points: IntArray  # (w,) point of each
    corners: IntArray  # (w,) a corner of the mesh that is this wedge
    materials: IntArray  # (w,) place in `Mesh.material_faces`, -1 for none
    triangles: IntArray  # (t, 3) wedges


def wedges_of(mesh: Mesh) -> Wedges:
    """The wedges of a mesh, in the order of their points; polygons are fans of triangles."""
    material = np.full(len(mesh.face_vertex_counts), -1)
    for number, one in enumerate(mesh.material_faces):
        material[one.faces] = number
    materials = np.repeat(material, mesh.face_vertex_counts)
    columns = [np.asarray(mesh.face_vertex_indices, np.int64), materials]
    columns += [_same(uv.values[uv.indices]) for uv in mesh.uv_sets if uv.indices is not None]
    if _by_corner(mesh):
        columns.append(_same(np.round(np.asarray(mesh.normals) * _NORMAL_STEPS)))
    rows, corners, inverse = np.unique(np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    triangles = inverse.ravel()[triangulate(mesh.face_vertex_counts).corners]
    return Wedges(mesh=mesh, points=rows[:, 0], corners=corners, materials=rows[:, 1], triangles=triangles)


def _same(values: FloatArray) -> IntArray:
    """(n,) a number for each row of (n, c) values, the same for the same values."""
    return np.asarray(np.unique(values, axis=0, return_inverse=True)[1]).ravel()


def _by_corner(mesh: Mesh) -> bool:
    return mesh.normals is not None and len(mesh.normals) != len(mesh.points)


def mesh_of(wedges: Wedges, triangles: IntArray) -> Mesh:
    """The mesh with `triangles` (t, 3) of its wedges alone, and the points that these or landmarks and anchor use.

    All that the points that stay have is as it was.
    """
    mesh = wedges.mesh
    marked = [one.indices for one in mesh.landmarks.values()] + ([[mesh.anchor]] if mesh.anchor is not None else [])
    kept = np.unique(np.concatenate([wedges.points[triangles].ravel(), *marked]).astype(np.int64))
    place = np.full(len(mesh.points), -1)
    place[kept] = np.arange(len(kept))
    # corners of a wedge share UVs, and normals but for less than a crease: one of them speaks for all
    corners = wedges.corners[triangles].ravel()
    return replace(
        mesh,
        points=mesh.points[kept],
        face_vertex_counts=np.full(len(triangles), 3, np.int32),
        face_vertex_indices=place[wedges.points[triangles]].astype(np.int32).ravel(),
        normals=None if mesh.normals is None else mesh.normals[corners if _by_corner(mesh) else kept],
        uv_sets=tuple(_uv_set(uv_set, kept, corners) for uv_set in mesh.uv_sets),
        colors=None if mesh.colors is None else mesh.colors[kept],
        skin=None if mesh.skin is None else _skin(mesh.skin, kept),
        blendshapes=tuple(_shape(blendshape, place) for blendshape in mesh.blendshapes),
        regions={name: mask[kept] for name, mask in mesh.regions.items()},
        point_subsets=_subsets(mesh.point_subsets, place),
        landmarks={name: _landmarks(one, place) for name, one in mesh.landmarks.items()},
        anchor=None if mesh.anchor is None else int(place[mesh.anchor]),
        material_faces=_material_faces(mesh, wedges.materials[triangles[:, 0]]),
    )


def _uv_set(uv: UvSet, kept: IntArray, corners: IntArray) -> UvSet:
    if uv.indices is None:
        return replace(uv, values=uv.values[kept])
    used, indices = np.unique(uv.indices[corners], return_inverse=True)
    return replace(uv, values=uv.values[used], indices=indices.ravel().astype(np.int32))


def _skin(skin: Skin, kept: IntArray) -> Skin:
    return replace(skin, joint_indices=skin.joint_indices[kept], joint_weights=skin.joint_weights[kept])


def _shape(shape: Blendshape, place: IntArray) -> Blendshape:
    points = place[shape.point_indices]
    kept = points >= 0
    shape = shape.changed(lambda offsets: offsets[kept], lambda offsets: offsets[kept])
    return replace(shape, point_indices=points[kept].astype(np.int32))


def _subsets(subsets: Mapping[str, IntArray], place: IntArray) -> dict[str, IntArray]:
    places = {name: place[points] for name, points in subsets.items()}
    return {name: points[points >= 0].astype(np.int32) for name, points in places.items()}


def _landmarks(landmarks: Landmarks, place: IntArray) -> Landmarks:
    return replace(landmarks, indices=place[landmarks.indices].astype(np.int32))


def _material_faces(mesh: Mesh, materials: IntArray) -> tuple[MaterialFaces, ...]:
    found = ((one.material, np.flatnonzero(materials == number)) for number, one in enumerate(mesh.material_faces))
    return tuple(MaterialFaces(material=name, faces=faces.astype(np.int32)) for name, faces in found if len(faces))
