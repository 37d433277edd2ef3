"""Skeletons and skins of several sources blended, and animations carried over to other rest transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.parts import Animation, Skeleton, Skin
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import decompose, rest_worlds, rotation_matrices

_GAP = 1e-9  # eigenvalues closer than this (of weights that sum to 1): no rotation is nearest to all sources
_SINGULAR = 1e-9  # of the product of the column lengths


def blend_skeletons(
    skeletons: Sequence[Skeleton],
    bind_worlds: FloatArray,
    positions: FloatArray,
    weights: FloatArray,
    *,
    aligned: bool = False,
) -> Skeleton:
    """The base's skeleton with blended bind and rest transforms.

    Bind transforms: orientations by the weighted chordal mean, what is left of each source's linear part (scale, and
    shear where there is some) by the weighted mean, positions as given. Rest transforms: what takes a source's joint
    from bind to rest, relative to its parent, is blended in the same way and applied to the new bind transforms; so
    the rest is the new bind pose where it was in every source, and sources that agree are given back. For roots it
    is taken relative to the space that they stand in: the place of the body joint that a face hangs under is kept.

    Axes of joints are as long as in each source's own file. Sources that were `aligned` have the base's size and place:
    there a source's axes are as long as the base's (the median over joints, which leaves what single joints are scaled
    by), and what takes its first root from bind to rest, which places the whole face, is what does so in the base.

    :param skeletons: of K sources with the same joints, the base first
    :param bind_worlds: (K, j, 4, 4) their bind transforms in the base's bind space
    :param positions: (j, 3) new places of the joints in the base's bind space
    :param weights: (j, K) shares, each row summing to 1
    :raises TopologyError: a singular transform
    """
    base = skeletons[0]
    if not base.joints:
        return base
    binds = np.stack([_float64(one.bind_transforms) for one in skeletons])
    rests = np.stack([rest_worlds(one) for one in skeletons])  # in skeleton space
    moved = _float64(bind_worlds) @ _inverse(binds, base)  # (K, j, 4, 4) a source's space -> the base's bind space
    if aligned:
        # not by `moved`: a face that is larger by its points has axes of length 1, one that is so by its root joint not
        sizes = np.cbrt(np.abs(np.linalg.det(_float64(bind_worlds)[..., :3, :3])))
        units = np.median(sizes / sizes[0], axis=1)[:, None, None]
    else:
        # a change of unit is one of places
        units = np.cbrt(np.abs(np.linalg.det(moved[:, :1, :3, :3])))[..., None]
    linear = blend_linear(_float64(bind_worlds)[..., :3, :3] / units[..., None], weights)
    bind = _transforms(linear, positions)
    # (K, j, 4, 4) what takes each joint from bind to rest in its own axes, both relative to the joint's parent
    relative = np.stack([_inverse(_local(a, base), base) @ _local(b, base) for a, b in zip(binds, rests, strict=True)])
    relative[..., :3, 3] *= units
    roots = base.parents < 0
    changes = (moved @ rests @ _inverse(binds, base) @ _inverse(moved, base))[:, roots]
    relative[:, roots] = changes[:1, :1] @ np.linalg.inv(changes[:, :1]) @ changes if aligned else changes
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

    With shares below 0 that eigenvector may be any, and a mean of scales may be 0 or mirror. There ``R_0 exp(sum_k a_k
    log(R_0^T R_k))`` goes on along the turn from the base to the others, and scales go on as powers.
    """
    _, rotations, scales, _ = decompose(_affine(matrices))
    outer = np.einsum("jk,kja,kjb->jab", weights, rotations, rotations)
    values, vectors = np.linalg.eigh(outer)
    mean = vectors[..., -1]
    tied = values[:, -1] - values[:, -2] < _GAP
    heaviest = rotations[np.argmax(weights, axis=1), np.arange(len(weights))]
    mean = np.where(tied[:, None], heaviest, mean)
    stretches = np.swapaxes(rotation_matrices(rotations), -1, -2) @ matrices
    blended = rotation_matrices(mean) @ np.einsum("jk,kjab->jab", weights, stretches)
    beyond = np.flatnonzero((weights < 0).any(axis=1))
    if len(beyond):
        shares, turns = weights[beyond], rotation_matrices(rotations[:, beyond])
        others = np.swapaxes(turns[0], -1, -2) @ turns
        steps = Rotation.from_matrix(others.reshape(-1, 3, 3)).as_rotvec().reshape(*others.shape[:-1])
        turned = turns[0] @ Rotation.from_rotvec(np.einsum("jk,kja->ja", shares, steps)).as_matrix()
        sizes = scales[:, beyond]
        size = np.sign(sizes[0]) * np.exp(np.einsum("jk,kja->ja", shares, np.log(np.abs(sizes))))
        sheared = np.einsum("jk,kjab->jab", shares, stretches[:, beyond] / sizes[:, :, None, :])
        blended[beyond] = turned @ (sheared * size[:, None, :])
    return np.asarray(blended)


def _local(worlds: FloatArray, base: Skeleton) -> FloatArray:
    """(j, 4, 4) transforms relative to the parent joint; those of roots as they are."""
    parents = base.parents
    above = np.where((parents < 0)[:, None, None], np.eye(4), _inverse(worlds, base)[parents])
    return np.asarray(above @ worlds)


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


def blend_skins(skins: Sequence[Skin | None], weights: FloatArray) -> Skin | None:
    """The skin ``sum_k a_k W_k`` of every point, normalised: as many influences as the widest source, largest first.

    Where the blend has more influences than that, the smallest are left out. Points where all sources agree (in
    float32) keep the base's weights as they are; where all points do, the result is the base's very skin. A source
    without skin, or without influences at a point, leaves its share to the others. geomBindTransform stays the base's.

    :param skins: of K sources, the base first; None where the base has none
    :param weights: (n, K) shares, each row summing to 1
    """
    base = skins[0]
    if base is None:
        return None
    given = [(k, skin) for k, skin in enumerate(skins) if skin is not None]
    merged = [
        _merged(skin.joint_indices, np.asarray(np.asarray(skin.joint_weights, dtype=np.float32).astype(np.float64)))
        for _, skin in given
    ]
    width = max(skin.joint_indices.shape[1] for _, skin in given)
    # points where all sources have the same influences, in float32
    first, *others = (_sorted(*one, width) for one in merged)
    agreed = np.ones(len(first[0]), dtype=bool)
    for other_joints, other_weights in others:
        agreed &= (first[0] == other_joints).all(axis=1)
        agreed &= (first[1].astype(np.float32) == other_weights.astype(np.float32)).all(axis=1)
    if agreed.all():
        return base
    joints = np.concatenate([numbers for numbers, _ in merged], axis=1)
    parts = [weights[:, k : k + 1] * part for (k, _), (_, part) in zip(given, merged, strict=True)]
    shares = np.concatenate(parts, axis=1)
    used, sums = _merged(joints, shares)
    indices, blended = _sorted(used, np.maximum(sums, 0.0), width)  # sums are below 0 where shares of sources are
    total = blended.sum(axis=1, keepdims=True)
    blended = blended / np.where(total > 0, total, 1.0)
    agreed |= total[:, 0] <= 0  # no source that has influences there has a share above 0: as in the base
    # sum_k a_k w equals w only up to rounding: put back, the weights that all agree on keep every digit
    indices[agreed], blended[agreed] = (one[agreed] for one in first)
    return replace(base, joint_indices=indices, joint_weights=blended)


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


def rebase_animations(animations: Sequence[Animation], old: Skeleton, new: Skeleton) -> tuple[Animation, ...]:
    """The same motion relative to rest: ``local_new = rest_new inverse(rest_old) local_old``.

    Bone coefficients are relative to rest and stay. Values of joints whose rest is the same (in float32) stay too, as
    do animations without joint transforms. Shear, which comes of unequal scales at rest, is lost as SkelAnimation can't
    hold it.

    :raises InputError: a joint that the skeleton lacks, or a quaternion of length 0
    :raises TopologyError: a singular rest transform
    """
    rests = [np.asarray(one.rest_transforms, dtype=np.float64) for one in (old, new)]
    moved = (rests[0].astype(np.float32) != rests[1].astype(np.float32)).any(axis=(1, 2))
    joints = {joint for joint, one in zip(old.joints, moved, strict=True) if one}
    return tuple(
        _rebased(animation, old, new) if joints & set(animation.joints) else animation for animation in animations
    )


def _rebased(animation: Animation, old: Skeleton, new: Skeleton) -> Animation:
    given = (animation.translations, animation.rotations, animation.scales)
    if all(part is None for part in given):
        return animation
    place = {joint: i for i, joint in enumerate(old.joints)}
    before = local_transforms(old, replace(animation, coefficients=None))
    used = [place[joint] for joint in animation.joints]
    rest_old, rest_new = (np.asarray(one.rest_transforms, dtype=np.float64)[used] for one in (old, new))
    singular = ~(np.abs(np.linalg.det(rest_old[:, :3, :3])) > 0)
    if singular.any():
        joint = animation.joints[int(np.argmax(singular))]
        raise TopologyError(f"{animation.name} -> {joint}", "singular rest transform, expected an invertible one")
    after = decompose(rest_new @ np.asarray(np.linalg.inv(rest_old)) @ before)
    was = decompose(before)
    kept = (rest_old.astype(np.float32) == rest_new.astype(np.float32)).all(axis=(1, 2))
    values = [one if part is None else np.asarray(part) for part, one in zip(given, was[:3], strict=True)]
    # signs of quaternions flip where those before do: samples are interpolated as they stand
    flips = np.ones(after.rotation.shape[:2])
    for one in (after.rotation, np.asarray(values[1], dtype=np.float64)):
        flips[1:] *= np.where(np.einsum("tjc,tjc->tj", one[1:], one[:-1]) < 0, -1.0, 1.0)
    rotations = after.rotation * np.cumprod(flips, axis=0)[..., None]
    return replace(
        animation,
        translations=_where(kept, values[0], after.translation),
        rotations=_where(kept, values[1], rotations),
        scales=_where(kept, values[2], after.scale),
    )


def _where(kept: BoolArray, before: FloatArray, after: FloatArray) -> FloatArray:
    return np.where(kept[None, :, None], before, after)
