"""Animations of a skeleton carried over to one with other rest transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import TopologyError
from facepipe.parts import Animation, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import decompose


def rebase_animations(animations: Sequence[Animation], old: Skeleton, new: Skeleton) -> tuple[Animation, ...]:
    """The same motion relative to rest: ``local_new = rest_new inverse(rest_old) local_old``.

    Bone coefficients are relative to rest and stay. Values of joints whose rest is the same (in float32) stay too, as
    do animations without joint transforms. Shear, which comes of unequal scales at rest, is lost as SkelAnimation can't
    hold it.

    :raises InputError: a joint that the skeleton has not, or a quaternion of length 0
    :raises TopologyError: a singular rest transform
    """
    rests = [np.asarray(one.rest_transforms, dtype=np.float64) for one in (old, new)]
    moved = (rests[0].astype(np.float32) != rests[1].astype(np.float32)).any(axis=(1, 2))
    joints = {joint for joint, one in zip(old.joints, moved, strict=True) if one}
    return tuple(_rebased(one, old, new) if joints & set(one.joints) else one for one in animations)


def _rebased(animation: Animation, old: Skeleton, new: Skeleton) -> Animation:
    given = (animation.translations, animation.rotations, animation.scales)
    if all(part is None for part in given):
        return animation
    place = {joint: i for i, joint in enumerate(old.joints)}
    before = local_transforms(old, replace(animation, coefficients=None))
    used = [place[joint] for joint in animation.joints]
    rest_old, rest_new = (np.asarray(one.rest_transforms, dtype=np.float64)[used] for one in (old, new))
    after = decompose(rest_new @ _inverse(rest_old, animation) @ before)
    was = decompose(before)
    kept = (rest_old.astype(np.float32) == rest_new.astype(np.float32)).all(axis=(1, 2))
    own = [one if part is None else np.asarray(part) for part, one in zip(given, was[:3], strict=True)]
    return replace(
        animation,
        translations=_where(kept, own[0], after.translation),
        rotations=_where(kept, own[1], _continuous(after.rotation, own[1])),
        scales=_where(kept, own[2], after.scale),
    )


def _where(kept: BoolArray, before: FloatArray, after: FloatArray) -> FloatArray:
    return np.where(kept[None, :, None], before, after)


def _continuous(rotations: FloatArray, before: FloatArray) -> FloatArray:
    """(T, j, 4) quaternions with signs that flip where those before do: samples are interpolated as they stand."""
    flips = np.ones(rotations.shape[:2])
    for one in (rotations, np.asarray(before, dtype=np.float64)):
        flips[1:] *= np.where(np.einsum("tjc,tjc->tj", one[1:], one[:-1]) < 0, -1.0, 1.0)
    return np.asarray(rotations * np.cumprod(flips, axis=0)[..., None])


def _inverse(rests: FloatArray, animation: Animation) -> FloatArray:
    singular = ~(np.abs(np.linalg.det(rests[:, :3, :3])) > 0)
    if singular.any():
        joint = animation.joints[int(np.argmax(singular))]
        raise TopologyError(f"{animation.name} -> {joint}", "singular rest transform, expected an invertible one")
    return np.asarray(np.linalg.inv(rests))
