"""Joints and animations of our own glTF files in stage space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import Animation, FaceParts, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.bone_coefficients import matrix_coefficients, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe_gltf.record_format import Record

_SAME = 1e-4  # of the skeleton's size: what float32 and a warning tool's digits may cost
_NEAR = 2e-4  # seconds: what is nearer is one key
_NOISE = 5e-7  # what float32 leaves of a coefficient at rest


def joints_as_recorded(record: Record, read: Skeleton) -> None:
    """:raises InputError: other joints than the record's, or joints that were moved since"""
    skeleton = record.face.skeleton
    count = len(skeleton.joints)
    shapes = {np.shape(one) for one in (skeleton.rest_transforms, skeleton.bind_transforms)}
    if len(read.joints) != count or shapes != {(count, 4, 4)} or not np.array_equal(read.parents, skeleton.parents):
        raise InputError("facepipe", f"{len(read.joints)} joints, expected {count} as facepipe wrote the file")
    if not count:
        return
    found = _stage_matrices(record, read.rest_transforms, read.parents < 0)
    size = float(np.abs(skeleton.rest_transforms).max())
    if float(np.abs(found - skeleton.rest_transforms).max()) > _SAME * size:
        raise InputError("facepipe", "joints moved by another program since facepipe wrote the file")


def filled_animations(
    record: Record, read: FaceParts, new_names: Mapping[str, str], shapes: Sequence[str]
) -> tuple[Animation, ...]:
    """The record's animations, moved as those that were read.

    :param new_names: the record's name of every shape that was read
    :param shapes: names of the record's shapes
    :raises InputError: other animations than the record's
    """
    recorded = record.face.animations
    if not len(recorded) == len(read.animations) == len(record.joints) == len(record.shapes):
        raise InputError("facepipe", f"{len(read.animations)} animations, expected {len(recorded)}")
    return tuple(
        _animation(record, read.skeleton, *of_animation, new_names, shapes)
        for of_animation in zip(recorded, read.animations, record.joints, record.shapes, strict=True)
    )


def _animation(
    record: Record,
    skeleton: Skeleton,
    husk: Animation,
    read: Animation,
    joints: IntArray,
    driven: IntArray,
    new_names: Mapping[str, str],
    shapes: Sequence[str],
) -> Animation:
    for numbers, count in ((joints, len(skeleton.joints)), (driven, len(shapes))):
        if numbers.ndim != 1 or (numbers.size and not (numbers.min() >= 0 and numbers.max() < count)):
            raise InputError(f"facepipe -> {husk.name}", f"numbers outside 0..{count - 1}")
    rows = _rows(husk, read)
    names = tuple(shapes[i] for i in driven)
    result = replace(
        husk,
        times=None if husk.times is None else np.asarray(husk.times, np.float64),
        joints=tuple(record.face.skeleton.joints[i] for i in joints),
        shapes=names,
        shape_weights=None if husk.shape_weights is None else _weights(read, rows, names, new_names),
    )
    return _moved(record, skeleton, result, read, rows, joints) if len(joints) else result


def _rows(husk: Animation, read: Animation) -> IntArray:
    """The samples that are keys of the record: inbetweens add more between them."""
    if husk.times is None:
        return np.zeros(1, np.int64)
    times = np.asarray(husk.times, np.float64)
    times = times - min(float(times.min(initial=0.0)), 0.0)
    read_times = np.zeros(1) if read.times is None else np.asarray(read.times, np.float64)
    after = np.minimum(np.searchsorted(read_times, times), len(read_times) - 1)
    before = np.maximum(after - 1, 0)
    rows = np.where(np.abs(read_times[before] - times) < np.abs(read_times[after] - times), before, after)
    if np.abs(read_times[rows] - times).max(initial=0.0) > _NEAR:
        raise InputError(f"facepipe -> {husk.name}", "other key times than facepipe wrote")
    return rows


def _weights(read: Animation, rows: IntArray, shapes: Sequence[str], new_names: Mapping[str, str]) -> FloatArray:
    result = np.zeros((len(rows), len(shapes)), np.float32)
    column = {new_names.get(name): i for i, name in enumerate(read.shapes)}
    for i, shape in enumerate(shapes):
        if shape in column and read.shape_weights is not None:
            result[:, i] = read.shape_weights[rows, column[shape]]
    return result


def _moved(
    record: Record, skeleton: Skeleton, husk: Animation, read: Animation, rows: IntArray, joints: IntArray
) -> Animation:
    """The animation with the joint transforms, coefficients or both that it had."""
    recorded = record.face.skeleton
    local = np.repeat(np.asarray(recorded.rest_transforms, np.float64)[None], len(rows), axis=0)
    if read.joints:
        place = {joint: i for i, joint in enumerate(skeleton.joints)}
        used = np.array([place[joint] for joint in read.joints])
        moving = local_transforms(skeleton, read)[rows]
        local[:, used] = _stage_matrices(record, moving, skeleton.parents[used] < 0)
    local = local[:, joints]
    values: dict[str, FloatArray | None] = {}
    if husk.coefficients is not None:
        rest = np.asarray(recorded.rest_transforms, np.float64)[joints]
        # local = rest C; rounding of float32 nodes would make coefficients of joints that never moved
        values["coefficients"] = _at_rest_where_near(matrix_coefficients(np.linalg.inv(rest) @ local), rest)
    trs = decompose(local)
    for name, value in zip(("translations", "rotations", "scales"), trs[:3], strict=True):
        if getattr(husk, name) is not None:
            values[name] = value.astype(np.float32)
    return replace(husk, **values)  # type: ignore[arg-type]


def _at_rest_where_near(coefficients: FloatArray, rest: FloatArray) -> FloatArray:
    """float32 coefficients without the noise of float32 nodes."""
    still = rest_coefficients(1)[0]
    reach = np.full(9, _NOISE)
    reach[:3] *= max(float(np.abs(rest[:, :3, 3]).max(initial=0.0)), 1.0)
    return np.asarray(np.where(np.abs(coefficients - still) <= reach, still, coefficients).astype(np.float32))


def _stage_matrices(record: Record, matrices: FloatArray, roots: npt.NDArray[np.bool_]) -> FloatArray:
    """(..., j, 4, 4) local joint matrices of the file, as those of the stage."""
    result = np.array(matrices, np.float64)
    result[..., roots, :, :] = np.linalg.inv(record.placement) @ result[..., roots, :, :]
    return np.asarray(np.linalg.inv(record.axes) @ result @ record.axes)
