"""Checks that faces are on one topology, and the way from one stage's world to another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import mesh_spaces

MILLIMETRES = FaceParts(name="millimetres", meters_per_unit=0.001, up_axis="Y")  # the space of whole points

_SINGULAR = 1e-12  # of the product of the column lengths
_Z_TO_Y = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def world_to_world(meters_per_unit: float, up_axis: str, base: FaceParts) -> FloatArray:
    """(4, 4) from the world of a stage with these units and up axis to the world of the stage of `base`."""
    turn = np.eye(4)
    if up_axis != base.up_axis:
        turn = _Z_TO_Y if up_axis == "Z" else _Z_TO_Y.T
    scale = meters_per_unit / base.meters_per_unit
    return np.asarray(np.diag([scale, scale, scale, 1.0]) @ turn)


def in_order(base: FaceParts, base_name: str, other: FaceParts, name: str) -> FaceParts:
    """`other` with the meshes of `base`, in its order.

    :raises TopologyError: a mesh that `other` lacks, or the first difference of one
    """
    own = {mesh.name: mesh for mesh in other.meshes}
    for mesh in base.meshes:
        if mesh.name not in own:
            found = ", ".join(own) or "none"
            raise TopologyError(name, f"no mesh '{mesh.name}', expected the meshes of {base_name}; it has {found}")
        check_same_faces(f"{name} -> {mesh.name}", own[mesh.name], mesh, base_name)
    return replace(other, meshes=tuple(own[mesh.name] for mesh in base.meshes))


def check_same_faces(where: str, mesh: Mesh, base: Mesh, base_name: str) -> None:
    """:raises TopologyError: the first count or face in which `mesh` is not like `base`"""
    for what, own, expected in (
        ("points", len(mesh.points), len(base.points)),
        ("faces", len(mesh.face_vertex_counts), len(base.face_vertex_counts)),
    ):
        if own != expected:
            raise TopologyError(where, f"{own:,} {what}, expected {expected:,} as in {base_name}")
    counts = np.flatnonzero(mesh.face_vertex_counts != base.face_vertex_counts)
    if len(counts):
        face = counts[0]
        own, expected = int(mesh.face_vertex_counts[face]), int(base.face_vertex_counts[face])
        raise TopologyError(where, f"face {face} has {own} corners, expected {expected} as in {base_name}")
    corners = np.flatnonzero(mesh.face_vertex_indices != base.face_vertex_indices)
    if len(corners):
        corner = corners[0]
        face = int(np.searchsorted(np.cumsum(base.face_vertex_counts), corner, side="right"))
        own, expected = int(mesh.face_vertex_indices[corner]), int(base.face_vertex_indices[corner])
        raise TopologyError(where, f"face {face} uses point {own}, expected point {expected} as in {base_name}")


def check_spaces(name: str, parts: FaceParts) -> None:
    """:raises TopologyError: a mesh or skeleton space that is flat, from which there is no way back"""
    spaces = zip([mesh.name for mesh in parts.meshes], mesh_spaces(parts), strict=True)
    for what, space in [(parts.skeleton.name, parts.skeleton.transform), *spaces]:
        check_invertible(f"{name} -> {what}", "transform", space)


def check_invertible(where: str, what: str, matrix: FloatArray) -> None:
    """:raises TopologyError: a (4, 4) matrix that is flat"""
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    if not abs(np.linalg.det(linear)) > _SINGULAR * np.linalg.norm(linear, axis=0).prod():
        raise TopologyError(where, f"singular {what}, expected an invertible one")
