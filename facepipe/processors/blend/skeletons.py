"""Skeletons of several sources blended: bind transforms at new places, and the rest pose that goes with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.parts import Skeleton
from facepipe.rig.trs import decompose, rotation_matrices

_GAP = 1e-9  # eigenvalues closer than this (of weights that sum to 1): no rotation is nearest to all sources
_SINGULAR = 1e-9  # of the product of the column lengths


def blend_skeletons(
    skeletons: Sequence[Skeleton], bind_worlds: FloatArray, positions: FloatArray, weights: FloatArray
) -> Skeleton:
    """The base's skeleton with blended bind and rest transforms.

    Bind transforms: orientations by the weighted chordal mean, what is left of each source's linear part (scale, and
    shear where there is some) by the weighted mean, positions as given. Rest transforms: what takes a source's joint
    from bind to rest, relative to its parent, is blended in the same way and applied to the new bind transforms; so
    the rest is the new bind pose where it was in every source, and sources that agree are given back. For roots it
    is taken relative to the space that they stand in: the place of the body joint that a face hangs under is kept.

    :param skeletons: of K sources, the base first
    :param bind_worlds: (K, j, 4, 4) their bind transforms in the base's joint order and bind space
    :param positions: (j, 3) new places of the joints in the base's bind space
    :param weights: (j, K) shares, each row summing to 1
    :raises TopologyError: a source that lacks a joint of the base, or a singular transform
    """
    base = skeletons[0]
    if not base.joints:
        return base
    places = [_places(skeleton, base, number) for number, skeleton in enumerate(skeletons)]
    own = np.stack([_float64(one.bind_transforms)[at] for one, at in zip(skeletons, places, strict=True)])
    rests = np.stack([_worlds(one)[at] for one, at in zip(skeletons, places, strict=True)])
    moved = _float64(bind_worlds) @ _inverse(own, base)  # (K, j, 4, 4) a source's space -> the base's bind space
    units = np.cbrt(np.abs(np.linalg.det(moved[:, :1, :3, :3])))[..., None]
    linear = blend_linear(_float64(bind_worlds)[..., :3, :3] / units[..., None], weights)
    bind = _transforms(linear, positions)
    relative = _relative(own, rests, base)
    relative[..., :3, 3] *= units
    roots = base.parents < 0
    relative[:, roots] = (moved @ rests @ _inverse(own, base) @ _inverse(moved, base))[:, roots]
    translation = np.einsum("jk,kjc->jc", weights, relative[..., :3, 3])
    change = _transforms(blend_linear(relative[..., :3, :3], weights), translation)
    local = _local(bind, base)
    rest = np.where(roots[:, None, None], change @ bind, local @ change)
    _inverse(bind, base)  # a skin needs it
    return replace(base, bind_transforms=bind, rest_transforms=rest)


def blend_linear(matrices: FloatArray, weights: FloatArray) -> FloatArray:
    """(j, 3, 3) blends of K linear maps (K, j, 3, 3) under shares (j, K): mean rotation times mean stretch.

    The rotation is the weighted chordal mean, the largest eigenvector of ``sum_k a_k q_k q_k^T``, which knows no signs
    of quaternions (Markley et al., Averaging Quaternions, 2007); where two are as good, that of the source with the
    largest share. The stretch ``R_k^T A_k`` of a source is its scale, and its shear where there is some.
    """
    rotations = decompose(_affine(matrices)).rotation
    outer = np.einsum("jk,kja,kjb->jab", weights, rotations, rotations)
    values, vectors = np.linalg.eigh(outer)
    mean = vectors[..., -1]
    tied = values[:, -1] - values[:, -2] < _GAP
    heaviest = rotations[np.argmax(weights, axis=1), np.arange(len(weights))]
    mean = np.where(tied[:, None], heaviest, mean)
    stretches = np.swapaxes(rotation_matrices(rotations), -1, -2) @ matrices
    return np.asarray(rotation_matrices(mean) @ np.einsum("jk,kjab->jab", weights, stretches))


def _relative(binds: FloatArray, rests: FloatArray, base: Skeleton) -> FloatArray:
    """(K, j, 4, 4) what takes each joint from bind to rest in its own axes, both relative to the joint's parent."""
    return np.stack(
        [_inverse(_local(bind, base), base) @ _local(rest, base) for bind, rest in zip(binds, rests, strict=True)]
    )


def _local(worlds: FloatArray, base: Skeleton) -> FloatArray:
    """(j, 4, 4) transforms relative to the parent joint; those of roots as they are."""
    parents = base.parents
    above = np.where((parents < 0)[:, None, None], np.eye(4), _inverse(worlds, base)[parents])
    return np.asarray(above @ worlds)


def _worlds(skeleton: Skeleton) -> FloatArray:
    """(j, 4, 4) rest transforms in skeleton space."""
    worlds = _float64(skeleton.rest_transforms).copy()
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            worlds[joint] = worlds[parent] @ worlds[joint]
    return worlds


def _places(skeleton: Skeleton, base: Skeleton, number: int) -> IntArray:
    own = {joint: i for i, joint in enumerate(skeleton.joints)}
    missing = next((joint for joint in base.joints if joint not in own), None)
    if missing is not None:
        raise TopologyError(
            f"source {number + 1} -> {skeleton.name}", f"no joint '{missing}', expected it as in the first"
        )
    return np.array([own[joint] for joint in base.joints], dtype=np.int64)


def _inverse(matrices: FloatArray, base: Skeleton) -> FloatArray:
    """Inverses of (..., j, 4, 4) affine matrices.

    :raises TopologyError: a singular one
    """
    linear = matrices[..., :3, :3]
    size = np.linalg.norm(linear, axis=-2).prod(axis=-1)
    singular = ~(np.abs(np.linalg.det(linear)) > _SINGULAR * size)
    if singular.any():
        joint = base.joints[int(np.argmax(singular.reshape(-1, len(base.joints)).any(axis=0)))]
        raise TopologyError(f"{base.name} -> {joint}", "singular transform, or mirrored in some sources only")
    return np.asarray(np.linalg.inv(matrices))


def _transforms(linear: FloatArray, translations: FloatArray) -> FloatArray:
    matrices = _affine(linear)
    matrices[..., :3, 3] = translations
    return matrices


def _affine(linear: FloatArray) -> FloatArray:
    matrices = np.zeros((*linear.shape[:-2], 4, 4))
    matrices[..., :3, :3] = linear
    matrices[..., 3, 3] = 1.0
    return matrices


def _float64(array: FloatArray) -> FloatArray:
    return np.asarray(array, dtype=np.float64)
