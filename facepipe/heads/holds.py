"""What points of a head lie on, for devices that put other persons on it: cards on skin, levels on the finest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_triangles
from facepipe.heads.surfaces import cards, kind_of
from facepipe.parts import FaceParts, Holds, Mesh

_SAME = 1e-6  # of a mesh's size: points of a level that are the finest's are the very same, but for their float32


def held(parts: FaceParts) -> FaceParts:
    """A face of the built-in head whose cards say what they lie on; those that somebody has moved don't."""
    head = next((mesh for mesh in parts.meshes if mesh.name == "Head"), None)
    if head is None:
        return parts
    meshes = []
    for mesh in parts.meshes:
        kind = kind_of(mesh, head)
        if kind is not None:
            own = cards(kind)
            holds = Holds(mesh=head.name, corners=own.corners, shares=own.shares, offsets=own.offsets)
            mesh = replace(mesh, holds=holds)
        meshes.append(mesh)
    return replace(parts, meshes=tuple(meshes))


def held_level(level: FaceParts, finest: FaceParts) -> FaceParts:
    """A level of detail whose meshes lie on those of the finest, which `held` made."""
    by_name = {mesh.name: mesh for mesh in finest.meshes}
    meshes = [
        replace(mesh, holds=_on(mesh, by_name[mesh.name])) if mesh.name in by_name else mesh for mesh in level.meshes
    ]
    return replace(level, meshes=tuple(meshes))


def _on(mesh: Mesh, finest: Mesh) -> Holds:
    points, triangles = finest.points, point_triangles(finest.face_vertex_counts, finest.face_vertex_indices)
    away, nearest = cKDTree(points).query(mesh.points)
    corners, shares = np.repeat(nearest[:, None], 3, axis=1), np.tile(np.eye(3)[0], (len(nearest), 1))
    off = np.flatnonzero(away > _SAME * np.ptp(points, axis=0).max())
    if len(off):
        found = closest_places(mesh.points[off], points, triangles)
        corners[off] = triangles[found.triangles]
        shares[off] = _shares(points[corners[off]], found.places)
    offsets = mesh.points - np.einsum("nk,nkc->nc", shares, points[corners])
    offsets[np.setdiff1d(np.arange(len(nearest)), off)] = 0.0
    own = finest.holds
    if own is None or len(off):
        return Holds(mesh=finest.name, corners=corners, shares=shares, offsets=offsets)
    return Holds(mesh=own.mesh, corners=own.corners[nearest], shares=own.shares[nearest], offsets=own.offsets[nearest])


def _shares(corners: FloatArray, places: FloatArray) -> FloatArray:
    """(n, 3) barycentric coordinates of places (n, 3) on triangles (n, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    sides = np.stack([b - a, c - a], axis=2)
    found = np.einsum("nij,nj->ni", np.linalg.pinv(sides), places - a)
    return np.column_stack([1.0 - found.sum(axis=1), found])
