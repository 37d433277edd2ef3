"""Skin weights of several sources blended per point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import Skin


def blend_skins(skins: Sequence[Skin | None], weights: FloatArray, joint_maps: Sequence[IntArray]) -> Skin | None:
    """The skin ``sum_k a_k W_k`` of every point, normalised: as many influences as the widest source, largest first.

    Where the blend has more influences than that, the smallest are left out. Points where all sources agree (in
    float32) keep the base's weights as they are; where all points do, the result is the base's very skin. A source
    without skin, or without influences at a point, leaves its share to the others. geomBindTransform stays the base's.

    :param skins: of K sources, the base first; None where the base has none
    :param weights: (n, K) shares, each row summing to 1
    :param joint_maps: of every source, (j,) numbers of its joints in the base
    """
    base = skins[0]
    if base is None:
        return None
    given = [(k, skin) for k, skin in enumerate(skins) if skin is not None]
    own = [_merged(joint_maps[k][skin.joint_indices], _stored(skin)) for k, skin in given]
    width = max(skin.joint_indices.shape[1] for _, skin in given)
    agreed = _agreed([_sorted(*one, width) for one in own])
    if agreed.all():
        return base
    joints = np.concatenate([one for one, _ in own], axis=1)
    shares = np.concatenate([weights[:, k : k + 1] * one for (k, _), (_, one) in zip(given, own, strict=True)], axis=1)
    indices, blended = _sorted(*_merged(joints, shares), width)
    total = blended.sum(axis=1, keepdims=True)
    blended = blended / np.where(total > 0, total, 1.0)
    indices[agreed], blended[agreed] = (one[agreed] for one in _sorted(*own[0], width))
    return replace(base, joint_indices=indices, joint_weights=blended)


def _stored(skin: Skin) -> FloatArray:
    """Weights as files hold them, for sums in double precision."""
    return np.asarray(np.asarray(skin.joint_weights, dtype=np.float32).astype(np.float64))


def _merged(joints: IntArray, weights: FloatArray) -> tuple[IntArray, FloatArray]:
    """The same influences with every joint once a point, in ascending order of joints; the rest has weight 0."""
    order = np.argsort(joints, axis=1, kind="stable")
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    first = np.ones(joints.shape, dtype=bool)
    first[:, 1:] = joints[:, 1:] != joints[:, :-1]
    run = np.cumsum(first) - 1  # number of the first entry that an entry adds to
    merged = np.zeros(joints.shape)
    merged[first] = np.bincount(run, weights.ravel(), minlength=int(first.sum()))
    return joints, merged


def _sorted(joints: IntArray, weights: FloatArray, width: int) -> tuple[IntArray, FloatArray]:
    """(n, width) largest influences first, the lower joint first among equals; those without weight are of joint 0."""
    if joints.shape[1] < width:
        more = ((0, 0), (0, width - joints.shape[1]))
        joints, weights = np.pad(joints, more), np.pad(weights, more)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    joints, weights = np.take_along_axis(joints, order, axis=1), np.take_along_axis(weights, order, axis=1)
    return np.where(weights > 0, joints, 0).astype(np.int32), weights


def _agreed(sources: Sequence[tuple[IntArray, FloatArray]]) -> npt.NDArray[np.bool_]:
    """(n,) whether all have the same influences, in float32."""
    joints, weights = sources[0]
    same = np.ones(len(joints), dtype=bool)
    for other_joints, other_weights in sources[1:]:
        same &= (joints == other_joints).all(axis=1)
        same &= (weights.astype(np.float32) == other_weights.astype(np.float32)).all(axis=1)
    return same
