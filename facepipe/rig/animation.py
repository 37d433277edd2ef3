"""Samples of animations as local joint transforms and shape weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import Animation, Skeleton
from facepipe.rig.bone_coefficients import coefficient_matrices
from facepipe.rig.trs import decompose, rotation_matrices

_ZERO = 1e-6  # a quaternion shorter than this has no direction
_JOINT_VALUES = ("translations", "rotations", "scales", "coefficients")


def local_transforms(skeleton: Skeleton, animation: Animation, joints: IntArray | None = None) -> FloatArray:
    """(T, j, 4, 4) local transforms of the animation's joints, in its order, at all samples.

    Bone coefficients win over the transforms where the animation has both: USD keeps scales in half precision. Of
    transforms, the parts that are not given (translations, rotations or scales) come from rest.

    :param joints: (j,) numbers of the animation's joints to keep; default all
    :raises InputError: a joint that the skeleton has not, or a quaternion of length 0
    """
    own = np.arange(len(animation.joints)) if joints is None else joints
    used = places(skeleton, animation, own)
    rest = np.asarray(skeleton.rest_transforms, dtype=np.float64)[used]
    if animation.coefficients is not None:
        return np.asarray(rest @ coefficient_matrices(np.asarray(animation.coefficients)[:, own]))
    samples = 1 if animation.times is None else len(animation.times)
    matrices = np.repeat(rest[None], samples, axis=0)
    if animation.rotations is not None or animation.scales is not None:
        at_rest = decompose(rest)
        rotations = at_rest.rotation if animation.rotations is None else np.asarray(animation.rotations)[:, own]
        scales = at_rest.scale if animation.scales is None else np.asarray(animation.scales)[:, own]
        _refuse_zero(animation, own, rotations)
        matrices[..., :3, :3] = rotation_matrices(rotations) * np.asarray(scales, np.float64)[..., None, :]
    if animation.translations is not None:
        matrices[..., :3, 3] = np.asarray(animation.translations)[:, own]
    return matrices


def sample_transforms(skeleton: Skeleton, animation: Animation, index: int = 0) -> FloatArray:
    """(j, 4, 4) local transforms of the whole skeleton at one sample; joints not animated are at rest.

    :raises InputError: as `local_transforms`
    """
    values = {name: getattr(animation, name) for name in _JOINT_VALUES}
    one: dict[str, Any] = {name: None if value is None else value[index : index + 1] for name, value in values.items()}
    local = np.array(skeleton.rest_transforms, dtype=np.float64)
    local[places(skeleton, animation)] = local_transforms(skeleton, replace(animation, times=None, **one))[0]
    return local


def sample_weights(animation: Animation, index: int = 0) -> dict[str, float]:
    """Shape weights at one sample, by name."""
    if animation.shape_weights is None:
        return {}
    return {name: float(weight) for name, weight in zip(animation.shapes, animation.shape_weights[index], strict=True)}


def places(skeleton: Skeleton, animation: Animation, joints: IntArray | None = None) -> IntArray:
    """(j,) numbers of the animation's joints in the skeleton.

    :param joints: as for `local_transforms`
    :raises InputError: a joint that the skeleton has not
    """
    place = {joint: i for i, joint in enumerate(skeleton.joints)}
    own = animation.joints if joints is None else [animation.joints[i] for i in joints]
    missing = [joint for joint in own if joint not in place]
    if missing:
        raise InputError(animation.name, f"'{missing[0]}' is no joint of the skeleton")
    return np.array([place[joint] for joint in own], dtype=np.int64)


def _refuse_zero(animation: Animation, own: IntArray, rotations: FloatArray) -> None:
    lengths = np.linalg.norm(np.asarray(rotations, dtype=np.float64), axis=-1)
    short = (np.atleast_2d(lengths) < _ZERO).any(axis=0)
    if short.any():
        joint = animation.joints[own[int(np.argmax(short))]]
        raise InputError(f"{animation.name} -> {joint}", "a rotation quaternion of length 0, expected unit length")
