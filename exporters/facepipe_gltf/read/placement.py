"""Skinned meshes brought from their own space into the skeleton's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.vectors import unit_vectors
from facepipe.parts import Blendshape, Inbetween, Mesh, identity


def placed(mesh: Mesh, matrix: FloatArray) -> Mesh:
    """A skinned `mesh` with its points moved by `matrix` (mesh space -> skeleton space at bind), so in metres.

    A matrix that mirrors or flattens would turn faces inside out: it becomes the geomBind instead.
    """
    if mesh.skin is None or np.array_equal(matrix, identity()):
        return mesh
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not 1e-30 < determinant < 1e30:
        return replace(mesh, skin=replace(mesh.skin, geom_bind_transform=matrix))
    move = _Move(matrix[:3, :3], np.linalg.inv(matrix[:3, :3]).T * np.cbrt(determinant))
    return replace(
        mesh,
        points=(np.asarray(mesh.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32),
        normals=None if mesh.normals is None else unit_vectors(move.normal(mesh.normals)),
        blendshapes=tuple(_shape(shape, move) for shape in mesh.blendshapes),
    )


@dataclass(frozen=True)
class _Move:
    """How offsets and normals (n, 3) follow: (3, 3) matrices."""

    linear: FloatArray
    turn: FloatArray

    def offset(self, values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ self.linear.T).astype(np.float32)

    def normal(self, values: FloatArray) -> FloatArray:
        return (np.asarray(values, np.float64) @ self.turn.T).astype(np.float32)

    def optional(self, values: FloatArray | None) -> FloatArray | None:
        return None if values is None else self.normal(values)


def _shape(shape: Blendshape, move: _Move) -> Blendshape:
    return replace(
        shape,
        offsets=move.offset(shape.offsets),
        normal_offsets=move.optional(shape.normal_offsets),
        inbetweens=tuple(_inbetween(inbetween, move) for inbetween in shape.inbetweens),
    )


def _inbetween(inbetween: Inbetween, move: _Move) -> Inbetween:
    return replace(
        inbetween, offsets=move.offset(inbetween.offsets), normal_offsets=move.optional(inbetween.normal_offsets)
    )
