"""Where a face stands: matrices of objects, and faces moved into the space of a stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh

from .read_armature import skeleton_at_rest

_NEAR = 5e-6  # of a matrix: what float32 angles and scales make of none
_UP = {"Y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "Z": np.eye(3)}  # from Z up


def snapped(matrix: FloatArray, to: FloatArray, size: float) -> FloatArray:
    """`to` where the matrix (4, 4) is the same in the precision of Blender; the matrix itself otherwise.

    :param size: of what it moves
    """
    scale = float(np.abs(to[:3, :3]).max())
    off = np.abs(matrix - to) <= np.array([[_NEAR * scale] * 3 + [_NEAR * max(size * scale, 1e-6)]])
    return to if off.all() else matrix


def between_stages(unit: float, up: str, to_unit: float, to_up: str) -> FloatArray:
    """(4, 4) matrix from world coordinates of one stage to those of another.

    :param unit: metres in a unit
    :param up: Y or Z
    """
    result = np.eye(4)
    result[:3, :3] = _UP[to_up] @ _UP[up].T * (unit / to_unit)
    return result


def inverse(matrix: FloatArray, where: str) -> FloatArray:
    """The inverse (4, 4) of the place of an object.

    :raises InputError: a place that flattens
    """
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
        raise InputError(where, "is scaled by 0, expected scales above 0")
    return np.linalg.inv(matrix)


def moved_mesh(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """The mesh with points, normals and shapes moved by an affine (4, 4) matrix.

    :raises InputError: a matrix that mirrors or flattens
    """
    if np.array_equal(matrix, np.eye(4)):
        return mesh
    linear = matrix[:3, :3]
    if np.linalg.det(linear) <= 0:
        raise InputError(mesh.name, "its object mirrors or flattens it, expected scales above 0 (apply the scale)")
    turn = np.linalg.inv(linear)

    def offsets(values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ linear.T).astype(np.float32)

    def shape(one: Blendshape) -> Blendshape:
        between: list[Inbetween] = [replace(each, offsets=offsets(each.offsets)) for each in one.inbetweens]
        return replace(one, offsets=offsets(one.offsets), inbetweens=tuple(between))

    normals = None
    if mesh.normals is not None:
        turned = np.asarray(mesh.normals, np.float64) @ turn
        normals = (turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)).astype(np.float32)
    points = np.asarray(mesh.points, np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        mesh,
        points=points.astype(np.float32),
        normals=normals,
        blendshapes=tuple(shape(one) for one in mesh.blendshapes),
    )


def moved_face(parts: FaceParts, matrix: FloatArray) -> FaceParts:
    """A face at rest moved by (4, 4): meshes and bones, which keep size 1.

    :raises InputError: a matrix that mirrors, flattens or stretches
    """
    if np.array_equal(matrix, np.eye(4)):
        return parts
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    if parts.skeleton.joints and np.ptp(scales) > 1e-4 * scales.max():
        x, y, z = scales
        raise InputError(parts.skeleton.name, f"scaled by {x:.4g}, {y:.4g}, {z:.4g}, expected one scale (apply it)")
    bones = matrix @ parts.skeleton.bind_transforms
    bones[:, :3, :3] /= scales.mean()
    return replace(
        parts,
        meshes=tuple(moved_mesh(mesh, matrix) for mesh in parts.meshes),
        skeleton=skeleton_at_rest(parts.skeleton.name, parts.skeleton.joints, bones).called(parts.skeleton.names),
    )


def placed_face(parts: FaceParts, matrix: FloatArray) -> FaceParts:
    """A face that stands elsewhere: only the transforms of its meshes and its skeleton change."""
    if np.array_equal(matrix, np.eye(4)):
        return parts
    return replace(
        parts,
        meshes=tuple(replace(mesh, transform=matrix @ mesh.transform) for mesh in parts.meshes),
        skeleton=replace(parts.skeleton, transform=matrix @ parts.skeleton.transform),
    )
