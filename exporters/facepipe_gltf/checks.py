"""Checks of a face before it is exported."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import ExportError
from facepipe.parts import Animation, Blendshape, FaceParts, Inbetween, Material, Mesh, Skeleton, Skin, TextureInput

_LARGEST = float(np.finfo(np.float32).max)


def check(parts: FaceParts) -> None:
    """Finite numbers, counts that fit each other, indices in range.

    :raises ExportError: naming the first array that is wrong
    """
    _finite(f"{parts.name} -> metersPerUnit", parts.meters_per_unit)
    if not parts.meters_per_unit > 0:
        raise ExportError(f"{parts.name} -> metersPerUnit", f"{parts.meters_per_unit:g}, expected above 0")
    _skeleton(f"{parts.name} -> {parts.skeleton.name}", parts.skeleton)
    for mesh in parts.meshes:
        _mesh(f"{parts.name} -> {mesh.name}", mesh, len(parts.skeleton.joints))
    for animation in parts.animations:
        _animation(f"{parts.name} -> {animation.name}", animation)
    for material in parts.materials:
        for name, value in _constants(material):
            _finite(f"{parts.name} -> {material.name} -> {name}", value)


def _skeleton(where: str, skeleton: Skeleton) -> None:
    _invertible(f"{where} -> transform", skeleton.transform)
    for name in ("bind_transforms", "rest_transforms"):
        _array(f"{where} -> {name}", getattr(skeleton, name), (len(skeleton.joints), 4, 4))
    singular = np.flatnonzero(_singular(np.asarray(skeleton.bind_transforms, dtype=np.float64)))
    if len(singular):
        _invertible(
            f"{where} -> {skeleton.joints[singular[0]]} -> bind transform", skeleton.bind_transforms[singular[0]]
        )
    if (skeleton.parents >= np.arange(len(skeleton.joints))).any():
        raise ExportError(where, "a joint comes before its parent, expected parents first")


def _mesh(where: str, mesh: Mesh, joint_count: int) -> None:
    count, corners = len(mesh.points), len(mesh.face_vertex_indices)
    _shape(f"{where} -> points", mesh.points, (count, 3))
    for name in ("points", "normals", "colors"):
        if getattr(mesh, name) is not None:
            _finite(f"{where} -> {name}", getattr(mesh, name))
    _invertible(f"{where} -> transform", mesh.transform)
    if int(np.sum(mesh.face_vertex_counts)) != corners:
        what = f"{corners} indices, expected {int(np.sum(mesh.face_vertex_counts))}"
        raise ExportError(f"{where} -> faceVertexIndices", what)
    _indices(f"{where} -> faceVertexIndices", mesh.face_vertex_indices, count)
    if mesh.normals is not None and len(mesh.normals) not in (count, corners):
        raise ExportError(f"{where} -> normals", f"{len(mesh.normals)} values, expected {count} or {corners}")
    if mesh.colors is not None:
        _shape(f"{where} -> colors", mesh.colors, (count, 3))
    for uv_set in mesh.uv_sets:
        _finite(f"{where} -> {uv_set.name}", uv_set.values)
        if uv_set.indices is None:
            _shape(f"{where} -> {uv_set.name}", uv_set.values, (count, 2))
        else:
            _shape(f"{where} -> {uv_set.name} -> indices", uv_set.indices, (corners,))
            _indices(f"{where} -> {uv_set.name} -> indices", uv_set.indices, len(uv_set.values))
    for one in mesh.material_faces:
        _indices(f"{where} -> {one.material} -> faces", one.faces, len(mesh.face_vertex_counts))
    if mesh.skin is not None:
        _skin(where, mesh.skin, count, joint_count)
    for shape in mesh.blendshapes:
        _blendshape(f"{where} -> {shape.name}", shape, count)


def _skin(where: str, skin: Skin, count: int, joint_count: int) -> None:
    width = np.shape(skin.joint_weights)[-1]
    _shape(f"{where} -> jointWeights", skin.joint_weights, (count, width))
    _shape(f"{where} -> jointIndices", skin.joint_indices, (count, width))
    _finite(f"{where} -> jointWeights", skin.joint_weights)
    _invertible(f"{where} -> geomBindTransform", skin.geom_bind_transform)
    _indices(f"{where} -> jointIndices", skin.joint_indices, joint_count)


def _blendshape(where: str, shape: Blendshape, count: int) -> None:
    indices = np.asarray(shape.point_indices)
    if not (indices[1:] > indices[:-1]).all():
        raise ExportError(f"{where} -> pointIndices", "not ascending, expected each point once, in order")
    if len(indices) and (indices[0] < 0 or indices[-1] >= count):
        raise ExportError(f"{where} -> pointIndices", f"index outside 0..{count - 1}")
    _offsets(where, shape, (len(indices), 3))
    for one in shape.inbetweens:
        _offsets(f"{where} -> {one.name}", one, (len(indices), 3))
        _finite(f"{where} -> {one.name} -> weight", one.weight)


def _offsets(where: str, sculpt: Blendshape | Inbetween, expected: tuple[int, ...]) -> None:
    for name, array in (("offsets", sculpt.offsets), ("normalOffsets", sculpt.normal_offsets)):
        _array(f"{where} -> {name}", array, expected)


def _animation(where: str, animation: Animation) -> None:
    count = animation.samples
    joints, shapes = len(animation.joints), len(animation.shapes)
    widths = {"translations": (joints, 3), "rotations": (joints, 4), "scales": (joints, 3), "coefficients": (joints, 9)}
    for name, width in widths.items():
        _array(f"{where} -> {name}", getattr(animation, name), (count, *width))
    if animation.rotations is not None and (np.linalg.norm(animation.rotations, axis=-1) < 1e-6).any():
        raise ExportError(f"{where} -> rotations", "a quaternion of length 0, expected unit length")
    _array(f"{where} -> shape weights", animation.shape_weights, (count, shapes))
    if animation.times is not None:
        _finite(f"{where} -> times", animation.times)
        if count == 0 or (np.diff(np.asarray(animation.times, dtype=np.float32)) <= 0).any():
            raise ExportError(f"{where} -> times", "not ascending in float32, expected at least one time, each later")


def _constants(material: Material) -> Iterator[tuple[str, Any]]:
    for name, value in vars(material).items():
        if isinstance(value, TextureInput):
            yield name, (*value.scale, *value.bias)
        elif isinstance(value, float | int | tuple):
            yield name, value


def _finite(where: str, values: Any) -> None:
    if not _are_finite(np.asarray(values)):
        raise ExportError(where, "NaN, infinity or beyond float32, expected finite numbers")


def _are_finite(values: npt.NDArray[Any]) -> bool:
    if values.dtype == np.float32:
        return bool(np.isfinite(values).all())
    return bool((np.abs(values.astype(np.float64)) <= _LARGEST).all())


def _invertible(where: str, matrix: Any) -> None:
    _finite(where, matrix)
    if _singular(np.asarray(matrix, dtype=np.float64)):
        raise ExportError(where, "singular matrix, expected an invertible one")


def _singular(matrices: FloatArray) -> npt.NDArray[np.bool_]:
    """(...,) of (..., 4, 4)."""
    linear = matrices[..., :3, :3]
    size = np.abs(linear).max(axis=(-1, -2), keepdims=True, initial=0.0)
    return np.asarray(np.abs(np.linalg.det(linear / np.where(size == 0, 1.0, size))) < 1e-12)


def _shape(where: str, array: Any, expected: tuple[int, ...]) -> None:
    if np.shape(array) != expected:
        raise ExportError(where, f"array of shape {np.shape(array)}, expected {expected}")


def _array(where: str, array: Any, expected: tuple[int, ...]) -> None:
    if array is not None:
        _shape(where, array, expected)
        _finite(where, array)


def _indices(where: str, indices: Any, count: int) -> None:
    array = np.asarray(indices)
    if array.size and (array.min() < 0 or array.max() >= count):
        raise ExportError(where, f"index outside 0..{count - 1}")
