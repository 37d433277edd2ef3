"""From stage space to glTF space (metres, Y up): of joints, and of the points, offsets and normals of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import FaceParts, Mesh, Skeleton
from facepipe.rig.trs import rest_worlds
from facepipe_gltf.buffers import merge

_UNIT = 2e-7


@dataclass(frozen=True)
class Space:
    """Where the parts of a face go.

    `world` takes stage world space to glTF space; `skeleton` takes skeleton space there. A joint's local matrix L
    becomes ``axes L inverse(axes)``, a root's ``placement axes L inverse(axes)``: `axes` holds the units, the axis
    change and the skeleton's uniform scale, so that joints carry none of them.
    """

    world: FloatArray  # (4, 4)
    skeleton: FloatArray  # (4, 4)
    axes: FloatArray  # (4, 4), linear
    placement: FloatArray  # (4, 4)

    def local(self, matrices: FloatArray, is_root: npt.NDArray[np.bool_]) -> FloatArray:
        """(..., j, 4, 4) local joint matrices of the stage, as those of glTF nodes."""
        turned = self.axes @ matrices @ np.linalg.inv(self.axes)
        turned[..., is_root, :, :] = self.placement @ turned[..., is_root, :, :]
        return np.asarray(turned)

    def inverse_binds(self, bind_transforms: FloatArray) -> FloatArray:
        """(j, 4, 4) inverse bind matrices for vertices in glTF space."""
        return np.asarray(self.axes @ np.linalg.inv(bind_transforms) @ np.linalg.inv(self.skeleton))


def space_of(parts: FaceParts) -> Space:
    """The conversion of a face; its skeleton's transform must be invertible."""
    world = parts.gltf_axes
    skeleton = world @ np.asarray(parts.skeleton.transform, dtype=np.float64)
    axes = np.eye(4)
    axes[:3, :3] = np.sign(world[:3, :3]) * np.cbrt(abs(np.linalg.det(skeleton[:3, :3])))
    return Space(world, skeleton, axes, skeleton @ np.linalg.inv(axes))


def numbers(values: Any) -> list[float]:
    """float32 values as JSON numbers, shortest form."""
    return [float(str(value)) + 0.0 for value in np.asarray(values, dtype=np.float32).ravel()]


@dataclass(frozen=True)
class Placement:
    """One matrix for all points of a mesh (1, 4, 4), or one for each (n, 4, 4)."""

    matrices: FloatArray

    @property
    def mirrored(self) -> bool:
        """Whether the matrices turn the surface inside out."""
        return bool(np.linalg.det(self.matrices[:, :3, :3]).sum() < 0)

    def points(self, points: FloatArray) -> FloatArray:
        """(n, 3) points in glTF space."""
        return self.offsets(points) + self.matrices[:, :3, 3]

    def offsets(self, offsets: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """(k, 3) offsets of the points `rows` in glTF space."""
        return _apply(self._at(self.matrices[:, :3, :3], rows), offsets)

    def normals(self, normals: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """(k, 3) unit normals at the points `rows` in glTF space; zero where they have no length."""
        turned = _apply(self._at(self._cofactors, rows), normals)
        length = _unless_near(np.linalg.norm(turned, axis=1), 1.0 / self._at(self._scales, rows))[:, None]
        return np.asarray(turned / np.where(length == 0, 1.0, length))

    def normal_offsets(self, offsets: FloatArray, normals: FloatArray, rows: IntArray) -> FloatArray:
        """(k, 3) offsets of unit normals; `normals` (k, 3) are those of the points `rows` in glTF space.

        They turn with the normals, and shrink by the factor that normalising shrinks those by.
        """
        matrices = self._at(self._cofactors, rows)
        x, y, z = _apply(np.swapaxes(self._at(self.matrices[:, :3, :3], rows), -1, -2), normals).T
        result = _apply(matrices, offsets)
        length = _unless_near(np.sqrt(x * x + y * y + z * z), self._at(self._scales, rows))
        for axis in result.T:
            axis *= length
        return result

    @cached_property
    def _cofactors(self) -> FloatArray:
        return np.asarray(np.swapaxes(np.linalg.inv(self.matrices[:, :3, :3]), -1, -2))

    @cached_property
    def _scales(self) -> FloatArray:
        return np.asarray(np.cbrt(np.abs(np.linalg.det(self.matrices[:, :3, :3]))))

    def _at(self, matrices: FloatArray, rows: IntArray | None) -> FloatArray:
        return matrices if rows is None or len(matrices) == 1 else matrices[rows]


def place(mesh: Mesh, skeleton: Skeleton, space: Space, skinned: bool) -> Placement:
    """Where the vertices of a mesh go.

    With a skin in the file they stay in bind pose; without one they are posed at rest. A mesh that has no skin goes
    where its transform says.
    """
    if mesh.skin is None:
        return Placement((space.world @ mesh.transform)[None])
    bind = np.asarray(mesh.skin.geom_bind_transform, dtype=np.float64)
    if skinned:
        return Placement((space.skeleton @ bind)[None])
    to_rest = rest_worlds(skeleton) @ np.linalg.inv(skeleton.bind_transforms)
    if np.allclose(to_rest, np.eye(4), rtol=0, atol=1e-12):
        return Placement((space.skeleton @ bind)[None])
    joints, weights = merge(mesh.skin)
    weights = weights / weights.sum(axis=1, keepdims=True)
    # x' = sum_j w_j rest_j bind_j^-1 G x: kept as a matrix a point, by which normals and offsets turn too
    blended = np.zeros((len(joints), 4, 4))
    for column in range(joints.shape[1]):
        blended += to_rest[joints[:, column]] * weights[:, column, None, None]
    return Placement(space.skeleton @ blended @ bind)


def _unless_near(lengths: FloatArray, expected: FloatArray) -> FloatArray:
    """(k,) `expected` in place of lengths that are it in float32: normals of unit length keep their bits."""
    return np.where(np.abs(lengths - expected) <= _UNIT * expected, expected, lengths)


def _apply(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    if len(matrices) != 1:
        return np.asarray(np.einsum("nij,nj->ni", matrices, np.asarray(vectors, dtype=np.float64)))
    matrix = np.asarray(matrices[0])
    if not ((matrix != 0).sum(axis=1) == 1).all():
        return np.asarray(np.asarray(vectors, dtype=np.float64) @ matrix.T)
    # units and up axis alone: every axis comes from one other, which is several times faster than a product
    result = np.empty(np.shape(vectors))
    for axis, source in enumerate(np.argmax(matrix != 0, axis=1)):
        np.multiply(vectors[:, source], matrix[axis, source], out=result[:, axis], dtype=np.float64)
    result += 0.0  # a negative zero becomes a plain one, as in a product
    return result
