"""Cards of hairs: faces of one topology may wear others, or none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh, TextureInput
from facepipe.processors.same_topology import check_same_faces
from facepipe.rig import mesh_spaces


def with_cards(base: FaceParts, other: FaceParts, to_base: FloatArray) -> tuple[FaceParts, tuple[str, ...]]:
    """`other` with the cards that `base` wears and it does not, on its own skin; and what these are called.

    A point of a card keeps its place on the largest mesh of the face, and its distance from there.

    :param to_base: (4, 4) from the other's bind space to that of the base, which have the same joints
    """
    missing = [mesh for mesh in base.meshes if _is_cards(mesh, base) and not _has(other, mesh)]
    own = {mesh.name: mesh for mesh in other.meshes}
    faces = [mesh for mesh in base.meshes if not _is_cards(mesh, base) and _has(other, mesh)]
    if not missing or not faces:
        return other, ()
    skin = max(faces, key=lambda mesh: len(mesh.points))
    back = np.linalg.inv(to_base)
    joints = np.array([other.skeleton.joints.index(joint) for joint in base.skeleton.joints] or [0], np.int32)
    worn = {}
    for mesh in missing:
        space = back @ _space(base, mesh)
        points = _carried(_bound(base, mesh), _bound(base, skin), _bound(other, own[skin.name]), skin, back)
        worn[mesh.name] = _placed(mesh, other, points, space[:3, :3], joints)
    kept = [mesh for mesh in other.meshes if mesh.name not in worn]
    return replace(other, meshes=(*kept, *worn.values())), tuple(worn)


def _is_cards(mesh: Mesh, parts: FaceParts) -> bool:
    """Whether pictures cut it out, as they do hairs."""
    cut = {one.name for one in parts.materials if isinstance(one.opacity, TextureInput)}
    used = {one.material for one in mesh.material_faces} | ({mesh.material} if mesh.material else set())
    return bool(used) and used <= cut


def _has(parts: FaceParts, mesh: Mesh) -> bool:
    """Whether a face has a mesh of that name and topology."""
    own = next((one for one in parts.meshes if one.name == mesh.name), None)
    if own is None:
        return False
    try:
        check_same_faces(mesh.name, own, mesh, parts.name)
    except TopologyError:
        return False
    return True


def _space(parts: FaceParts, mesh: Mesh) -> FloatArray:
    return next(space for one, space in zip(parts.meshes, mesh_spaces(parts), strict=True) if one is mesh)


def _bound(parts: FaceParts, mesh: Mesh) -> FloatArray:
    """(n, 3) points in bind space."""
    space = _space(parts, mesh)
    return np.asarray(mesh.points, np.float64) @ space[:3, :3].T + space[:3, 3]


def _carried(points: FloatArray, surface: FloatArray, other: FloatArray, mesh: Mesh, back: FloatArray) -> FloatArray:
    """The points (m, 3) as far from the places that they are nearest to, now on the other surface."""
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    found = closest_places(points, surface, triangles)
    shares = place_shares(found, surface, triangles)
    places = np.einsum("mk,mkc->mc", shares, other[triangles[found.triangles]])
    return np.asarray(places + (points - found.places) @ back[:3, :3].T)


def _placed(mesh: Mesh, other: FaceParts, points: FloatArray, turn: FloatArray, joints: IntArray) -> Mesh:
    """The mesh with points in bind space, on the joints of another skeleton."""
    skin = mesh.skin and replace(
        mesh.skin, joint_indices=joints[mesh.skin.joint_indices], geom_bind_transform=np.eye(4)
    )
    return replace(
        mesh,
        points=points,
        transform=other.skeleton.transform,
        skin=skin,
        normals=None,
        blendshapes=tuple(_turned(shape, turn) for shape in mesh.blendshapes),
    )


def _turned(shape: Blendshape, turn: FloatArray) -> Blendshape:
    def one(inbetween: Inbetween) -> Inbetween:
        return replace(inbetween, offsets=inbetween.offsets @ turn.T, normal_offsets=None)

    inbetweens = tuple(map(one, shape.inbetweens))
    return replace(shape, offsets=shape.offsets @ turn.T, normal_offsets=None, inbetweens=inbetweens)
