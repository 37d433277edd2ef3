"""Every difference between two parts, one line each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest

from facepipe.parts import Animation, Blendshape, FaceParts, Mesh, Skin, UvSet


def differences(one: FaceParts, other: FaceParts, tolerance: float = 0.0) -> list[str]:
    """Lines like ``meshes.Head.blendshapes.jawOpen.offsets: 1e-08 apart``; empty for equal faces.

    Two ways to say one thing are equal: the order in which a point lists its joints, UV values by whatever index,
    points of a shape that it does not move, and the sign of a quaternion.

    :param tolerance: numbers this near, relative to the largest of their array, are equal
    """
    return list(_walk(_plain(one), _plain(other), "", tolerance))


def _plain(parts: FaceParts) -> FaceParts:
    return dataclasses.replace(
        parts,
        meshes=tuple(map(_plain_mesh, parts.meshes)),
        animations=tuple(map(_plain_animation, parts.animations)),
    )


def _plain_animation(animation: Animation) -> Animation:
    if not animation.joints:
        return dataclasses.replace(animation, translations=None, rotations=None, scales=None, coefficients=None)
    if animation.rotations is None:
        return animation
    rotations = np.asarray(animation.rotations, np.float64)
    largest = np.take_along_axis(rotations, np.abs(rotations).argmax(axis=-1)[..., None], axis=-1)
    nearest = np.abs(np.abs(rotations).max(axis=-1, keepdims=True) - np.abs(rotations)) < 1e-5  # which may be several
    first = np.take_along_axis(rotations, nearest.argmax(axis=-1)[..., None], axis=-1)
    return dataclasses.replace(animation, rotations=rotations * np.sign(np.where(largest == 0, 1.0, first)))


def _plain_mesh(mesh: Mesh) -> Mesh:
    corners = np.arange(len(mesh.face_vertex_indices), dtype=np.int32)
    uvs = [
        uv_set
        if uv_set.indices is None
        else UvSet(name=uv_set.name, values=uv_set.values[uv_set.indices], indices=corners)
        for uv_set in mesh.uv_sets
    ]
    skin = None if mesh.skin is None else _plain_skin(mesh.skin)
    shapes = tuple(map(_plain_shape, mesh.blendshapes))
    return dataclasses.replace(mesh, uv_sets=tuple(uvs), skin=skin, blendshapes=shapes)


def _plain_skin(skin: Skin) -> Skin:
    dense = np.zeros((len(skin.joint_indices), int(np.max(skin.joint_indices, initial=0)) + 1))
    rows = np.repeat(np.arange(len(dense)), skin.joint_indices.shape[1])
    np.add.at(dense, (rows, skin.joint_indices.ravel()), np.asarray(skin.joint_weights, np.float64).ravel())
    width = int((dense > 0).sum(axis=1).max(initial=1))
    order = np.argsort(-dense, axis=1, kind="stable")[:, :width]
    weights = np.take_along_axis(dense, order, axis=1)
    return dataclasses.replace(skin, joint_indices=np.where(weights > 0, order, 0), joint_weights=weights)


def _plain_shape(shape: Blendshape) -> Blendshape:
    arrays = [shape.offsets, shape.normal_offsets, *(inbetween.offsets for inbetween in shape.inbetweens)]
    arrays += [inbetween.normal_offsets for inbetween in shape.inbetweens]
    moving = np.zeros(len(shape.point_indices), bool)
    for array in arrays:
        if array is not None:
            moving |= np.asarray(array).any(axis=1)
    return dataclasses.replace(
        shape,
        point_indices=shape.point_indices[moving],
        offsets=shape.offsets[moving],
        normal_offsets=None if shape.normal_offsets is None else shape.normal_offsets[moving],
        inbetweens=tuple(
            dataclasses.replace(
                inbetween,
                offsets=inbetween.offsets[moving],
                normal_offsets=None if inbetween.normal_offsets is None else inbetween.normal_offsets[moving],
            )
            for inbetween in shape.inbetweens
        ),
    )


def _walk(one: object, other: object, where: str, tolerance: float) -> Iterator[str]:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        yield from _arrays(one, other, where, tolerance)
    elif dataclasses.is_dataclass(one) and type(one) is type(other):
        for field in dataclasses.fields(one):
            yield from _walk(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}", tolerance)
    elif isinstance(one, Mapping) and isinstance(other, Mapping):
        for key in dict.fromkeys([*one, *other]):
            yield from _walk(one.get(key), other.get(key), f"{where}[{key}]", tolerance)
    elif _is_list(one) and _is_list(other):
        if len(one) != len(other):  # type: ignore[arg-type]
            yield f"{where.strip('.')}: {_short(one)} and {_short(other)}"
            return
        for i, (left, right) in enumerate(zip(one, other, strict=True)):  # type: ignore[call-overload]
            yield from _walk(left, right, f"{where}.{getattr(left, 'name', i)}", tolerance)
    elif isinstance(one, float) and isinstance(other, float):
        if abs(one - other) > max(tolerance, 1e-7) * abs(one):
            yield f"{where.strip('.')}: {one} and {other}"
    elif type(one) is not type(other) or one != other:
        yield f"{where.strip('.')}: {_short(one)} and {_short(other)}"


def _is_list(value: object) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _arrays(one: np.ndarray, other: np.ndarray, where: str, tolerance: float) -> Iterator[str]:
    if one.shape != other.shape:
        yield f"{where.strip('.')}: {one.shape} and {other.shape}"
    elif one.dtype.kind not in "f" and other.dtype.kind not in "f":
        if not np.array_equal(one, other):
            yield f"{where.strip('.')}: {int((one != other).sum())} numbers differ"
    else:
        left, right = one.astype(np.float32).astype(float), other.astype(np.float32).astype(float)
        apart = float(np.abs(left - right).max(initial=0.0))
        if not apart <= tolerance * float(np.abs(left).max(initial=0.0)):
            yield f"{where.strip('.')}: {apart:.2g} apart"


def _short(value: object) -> str:
    return f"{len(value)} entries" if isinstance(value, tuple | list | np.ndarray) else repr(value)[:200]


def assert_same(one: object, other: object, where: str = "parts") -> None:
    """Equal dataclasses, arrays, mappings and values, float32 precision."""
    if dataclasses.is_dataclass(one):
        assert type(one) is type(other), where
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    elif isinstance(one, np.ndarray):
        np.testing.assert_allclose(other, one, atol=1e-7, err_msg=where)
    elif isinstance(one, dict):
        assert list(one) == list(other), where  # type: ignore[call-overload]
        for key in one:
            assert_same(one[key], other[key], f"{where}[{key}]")  # type: ignore[index]
    elif isinstance(one, tuple) and one and not isinstance(one[0], float | str):
        assert len(one) == len(other), where  # type: ignore[arg-type]
        for i, (mine, its) in enumerate(zip(one, other, strict=True)):  # type: ignore[call-overload]
            assert_same(mine, its, f"{where}[{i}]")
    elif isinstance(one, float) or (isinstance(one, tuple) and one and isinstance(one[0], float)):
        assert other == pytest.approx(one, abs=1e-7), where
    else:
        assert one == other, where
