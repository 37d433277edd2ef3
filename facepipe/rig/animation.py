"""Samples of animations as local joint transforms and shape weights, and animations at whole frames of another rate.

What formats that blend joints linearly lose of meshes with dual quaternions is measured over such samples.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.parts import Animation, FaceParts, Skeleton
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients
from facepipe.rig.trs import Trs, decompose, rotation_matrices, slerp

_NO_QUATERNION = 1e-6  # a quaternion shorter than this has no direction
_JOINT_VALUES = ("translations", "rotations", "scales", "coefficients")
TICK = 2.0**-10  # seconds before the next key until which a value is held that then changes at once
ON_FRAME = 1e-3  # frames that a time may be off
_FLAT = 1e-12  # determinant of a rest transform that can't be inverted
_FLOAT32_ERROR = 1e-6  # an error below this is that of float32
_POSES_MEASURED = 20  # of each animation, evenly spread


def local_transforms(skeleton: Skeleton, animation: Animation, joints: IntArray | None = None) -> FloatArray:
    """(T, j, 4, 4) local transforms of the animation's joints, in its order, at all samples.

    Bone coefficients win over the transforms where the animation has both: USD keeps scales in half precision. Of
    transforms, the parts that are not given (translations, rotations or scales) come from rest.

    :param joints: (j,) numbers of the animation's joints to keep; default all
    :raises InputError: a joint that the skeleton lacks, or a quaternion of length 0
    """
    chosen = np.arange(len(animation.joints)) if joints is None else joints
    used = places(skeleton, animation, chosen)
    rest = np.asarray(skeleton.rest_transforms, dtype=np.float64)[used]
    if animation.coefficients is not None:
        return np.asarray(rest @ coefficient_matrices(np.asarray(animation.coefficients)[:, chosen]))
    samples = animation.samples
    matrices = np.repeat(rest[None], samples, axis=0)
    # translations alone leave the linear part of rest as it is, with a shear that rotation and scale cannot hold
    if animation.rotations is not None or animation.scales is not None:
        at_rest = decompose(rest)
        rotations = at_rest.rotation if animation.rotations is None else np.asarray(animation.rotations)[:, chosen]
        scales = at_rest.scale if animation.scales is None else np.asarray(animation.scales)[:, chosen]
        lengths = np.linalg.norm(np.asarray(rotations, dtype=np.float64), axis=-1)
        short = (np.atleast_2d(lengths) < _NO_QUATERNION).any(axis=0)
        if short.any():
            joint = animation.joints[chosen[int(np.argmax(short))]]
            raise InputError(f"{animation.name} -> {joint}", "a rotation quaternion of length 0, expected unit length")
        matrices[..., :3, :3] = rotation_matrices(rotations) * np.asarray(scales, np.float64)[..., None, :]
    if animation.translations is not None:
        matrices[..., :3, 3] = np.asarray(animation.translations)[:, chosen]
    return matrices


def sample_transforms(skeleton: Skeleton, animation: Animation, index: int = 0) -> FloatArray:
    """(j, 4, 4) local transforms of the whole skeleton at one sample; joints not animated are at rest.

    :raises InputError: as `local_transforms`
    """
    values = {name: getattr(animation, name) for name in _JOINT_VALUES}
    frame: dict[str, Any] = {
        name: None if value is None else value[index : index + 1] for name, value in values.items()
    }
    local = np.array(skeleton.rest_transforms, dtype=np.float64)
    local[places(skeleton, animation)] = local_transforms(skeleton, replace(animation, times=None, **frame))[0]
    return local


def sample_weights(animation: Animation, index: int = 0) -> dict[str, float]:
    """Shape weights at one sample, by name."""
    if animation.shape_weights is None:
        return {}
    return {name: float(weight) for name, weight in zip(animation.shapes, animation.shape_weights[index], strict=True)}


def places(skeleton: Skeleton, animation: Animation, joints: IntArray | None = None) -> IntArray:
    """(j,) numbers of the animation's joints in the skeleton.

    :param joints: as for `local_transforms`
    :raises InputError: a joint that the skeleton lacks
    """
    place = {joint: i for i, joint in enumerate(skeleton.joints)}
    paths = animation.joints if joints is None else [animation.joints[i] for i in joints]
    missing = [joint for joint in paths if joint not in place]
    if missing:
        raise InputError(animation.name, f"'{missing[0]}' is not a joint of the skeleton")
    return np.array([place[joint] for joint in paths], dtype=np.int64)


def with_exact_scales(skeleton: Skeleton, animation: Animation) -> tuple[Animation, str]:
    """The animation, with bone coefficients too where SkelAnimation would round its scales to half precision; a line
    where these can't hold its motion.

    :raises InputError: as `local_transforms`
    """
    scales = animation.scales
    with np.errstate(over="ignore"):  # what is too large for half precision is infinity there
        if scales is None or np.array_equal(scales.astype(np.float16).astype(np.float32), scales):
            return animation, ""
    rest = np.asarray(skeleton.rest_transforms)[places(skeleton, animation)]
    if np.abs(np.linalg.det(rest[:, :3, :3])).min() < _FLAT:
        return animation, "scales are kept in half precision: joints are flat at rest"
    relative = np.linalg.inv(rest) @ local_transforms(skeleton, animation)
    coefficients = matrix_coefficients(relative)
    lost = float(np.abs(coefficient_matrices(coefficients) - relative).max())
    if lost > 1e-5 * max(1.0, float(np.abs(relative).max())):
        return animation, f"scales are kept in half precision: joints sheared against rest by up to {lost:.2g}"
    return replace(animation, coefficients=coefficients.astype(np.float32)), ""


def whole_frames(first: float, last: float, fps: float) -> FloatArray:
    """(t,) seconds of the frames from `first` to `last`, outermost ones included."""
    low, high = np.floor(first * fps + ON_FRAME), np.ceil(last * fps - ON_FRAME)
    return np.asarray(np.arange(low, max(high, low) + 1) / fps)


def resampled(skeleton: Skeleton, animation: Animation, fps: float, mm_per_unit: float) -> tuple[Animation, str]:
    """The animation at whole frames of `fps`, and how far lines between these are from its samples, for people.

    Between samples translations, scales and weights are straight, rotations slerp, as USD has them; beyond the ends the
    animation is held. A pose stays as it is.

    :raises InputError: as `local_transforms`
    """
    if animation.times is None:
        return animation, ""
    old = np.asarray(animation.times, dtype=np.float64)
    new = whole_frames(old[0], old[-1], fps)
    off: list[str] = []
    # between two keys USD goes by quaternions; Euler angles of coefficients would go another way
    changed = replace(animation, times=new, coefficients=None)
    if animation.joints:
        trs = decompose(local_transforms(skeleton, animation))
        there = _at(trs, old, new)
        changed = replace(changed, translations=there.translation, rotations=there.rotation, scales=there.scale)
        lines = _at(there, new, old)
        chord = [np.linalg.norm(trs.rotation - sign * lines.rotation, axis=-1) for sign in (1, -1)]
        # by the chord 2 sin(angle / 4): arccos of the product is 4e-5 of an angle of 1e-6 off, and gives 0 for 1e-8
        angle = 4 * np.arcsin(np.minimum(np.minimum(*chord) / 2, 1.0)).max(initial=0.0)
        moved = np.linalg.norm(trs.translation - lines.translation, axis=-1).max(initial=0.0)
        off += _unless_tiny("translation", moved * mm_per_unit, " mm")
        off += _unless_tiny("rotation", angle, " rad")
        off += _unless_tiny("scale", np.abs(trs.scale - lines.scale).max(initial=0.0), "")
    if animation.shape_weights is not None:
        weights = np.asarray(animation.shape_weights, dtype=np.float64)
        there_weights = _lines(weights, old, new)
        changed = replace(changed, shape_weights=there_weights)
        off += _unless_tiny("weights", np.abs(_lines(there_weights, new, old) - weights).max(initial=0.0), "")
    return changed, ", ".join(off) or "nothing"


def at_times(skeleton: Skeleton, animation: Animation, times: FloatArray) -> Animation:
    """A clip at the seconds `times` (t,): straight between its samples, rotations slerp, held beyond its ends.

    :raises InputError: as `local_transforms`
    """
    old = np.asarray(animation.times, dtype=np.float64)
    changed = replace(animation, times=times, coefficients=None)
    if animation.joints:
        there = _at(decompose(local_transforms(skeleton, animation)), old, times)
        changed = replace(changed, translations=there.translation, rotations=there.rotation, scales=there.scale)
    if animation.shape_weights is not None:
        weights = _lines(np.asarray(animation.shape_weights, dtype=np.float64), old, times)
        changed = replace(changed, shape_weights=weights)
    return changed


def _unless_tiny(name: str, size: float, unit: str) -> list[str]:
    return [f"{name} {size:.2g}{unit}"] if size > _FLOAT32_ERROR else []


def _at(trs: Trs, old: FloatArray, new: FloatArray) -> Trs:
    """(t, j, ...) transforms of samples at `old`, at the times `new`."""
    left, right, share = between(old, new)
    return Trs(
        _lines(trs.translation, old, new),
        slerp(trs.rotation[left], trs.rotation[right], share[:, None, None]),
        _lines(trs.scale, old, new),
        trs.sheared[left] | trs.sheared[right],
    )


def _lines(values: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    left, right, share = between(old, new)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[left] + share * (values[right] - values[left]))


def between(old: FloatArray, new: FloatArray) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """The samples around each new time, and how far it is from the one to the other, 0 to 1; ends are held."""
    left = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 1)
    right = np.minimum(left + 1, len(old) - 1)
    span = np.where(right > left, old[right] - old[left], 1.0)
    return left, right, np.clip((new - old[left]) / span, 0.0, 1.0)


def linear_skinning_notes(parts: FaceParts) -> tuple[str, ...]:
    """A line for the report of a writer that blends joints linearly, where the face has meshes that don't."""
    names = [mesh.name for mesh in parts.meshes if mesh.skin is not None and mesh.skin.dual_quaternion]
    if not names:
        return ()
    owners = names[0] if len(names) == 1 else f"{len(names)} meshes"
    line = f"{owners}: skinned by dual quaternions, which the format lacks: skinned linearly in the file"
    from facepipe.rig.rig import build  # with scipy, which reading and writing a stage need not

    rig = build(parts)
    linear = replace(rig, dual=None)
    apart, poses = 0.0, 0
    for animation in parts.animations:
        count = animation.samples
        for index in np.unique(np.linspace(0, count - 1, min(count, _POSES_MEASURED)).astype(np.int64)).tolist():
            local = sample_transforms(parts.skeleton, animation, index)
            weights = rig.weight_vector(
                {name: weight for name, weight in sample_weights(animation, index).items() if name in rig.shapes}
            )
            # the same points and weights in both: the distance is what the method alone makes
            pair = [either.evaluate(weights, joint_transforms=local) for either in (rig, linear)]
            apart = max(apart, float(np.linalg.norm(pair[0] - pair[1], axis=1).max(initial=0.0)))
            poses += 1
    if not poses:
        return (f"{line}; the face has no animation to measure the difference on",)
    return (f"{line}, up to {apart * parts.meters_per_unit * 1000:.3g} mm off over {poses} poses of its animations",)
