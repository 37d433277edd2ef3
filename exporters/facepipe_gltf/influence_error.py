"""How far the influences that an export leaves out move points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, FaceParts, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe_gltf.baking import Baked
from facepipe_gltf.influences import LOST, merge
from facepipe_gltf.placement import Space, accumulate

_STILL = 1e-13  # vertex matrices nearer to the identity than this are at rest but for rounding


def influence_error(parts: FaceParts, meshes: Sequence[Baked], space: Space) -> float | None:
    """Largest distance in metres that the influences left out move a point, over the face's poses and animations.

    None where no influence is left out or there is no pose to measure at.
    """
    changes = [_change(one, len(parts.skeleton.joints)) for one in meshes if one.influences is not None]
    changes = [one for one in changes if len(one.points)]
    if not changes:
        return None
    skeleton = parts.skeleton
    poses = _poses(parts.animations, skeleton)
    if poses is None:
        return None
    worlds = accumulate(space.local(poses, skeleton.parents < 0), skeleton.parents)
    matrices = worlds @ space.inverse_binds(np.asarray(skeleton.bind_transforms, dtype=np.float64))
    return max(_longest_shift(one, matrices) for one in changes)


class _Change(NamedTuple):
    """What happens to the weights of those points of a mesh that lose influences."""

    points: FloatArray  # (n, 3) metres
    weights: FloatArray  # (j, n), summing to 0 for each point


def _change(baked: Baked, joint_count: int) -> _Change:
    if baked.influences is None or baked.mesh.skin is None:
        return _Change(np.zeros((0, 3)), np.zeros((joint_count, 0)))
    points = np.flatnonzero(baked.influences.lost > LOST)
    change = np.zeros((joint_count, len(points)))
    columns = np.arange(len(points))[:, None]
    joints, weights = merge(baked.mesh.skin, points)
    np.add.at(change, (joints, columns), -weights / weights.sum(axis=1, keepdims=True))
    np.add.at(change, (baked.influences.joints[points], columns), baked.influences.weights[points])
    return _Change(baked.points[points], change)


def _poses(animations: Sequence[Animation], skeleton: Skeleton) -> FloatArray | None:
    """(T, j, 4, 4) local matrices of every key of every animation that moves a joint; None: no animation does."""
    number = {joint: i for i, joint in enumerate(skeleton.joints)}
    poses = []
    for animation in _joined(animations):
        own = [i for i, joint in enumerate(animation.joints) if joint in number]
        if own:
            used = np.array([number[animation.joints[i]] for i in own])
            keys = local_transforms(skeleton, animation, np.array(own))
            every = np.empty((len(keys), *skeleton.rest_transforms.shape))
            every[:] = skeleton.rest_transforms
            every[:, used] = keys
            poses.append(every)
    return np.concatenate(poses) if poses else None


def _joined(animations: Sequence[Animation]) -> list[Animation]:
    """Animations of bone coefficients for the same joints as one: faces have a pose for every shape."""
    groups: dict[tuple[str, ...], list[FloatArray]] = {}
    others = []
    for one in animations:
        if one.coefficients is None:
            others.append(one)
        else:
            groups.setdefault(one.joints, []).append(np.asarray(one.coefficients))
    return others + [
        Animation(name="", joints=joints, coefficients=np.concatenate(keys)) for joints, keys in groups.items()
    ]


def _longest_shift(change: _Change, matrices: FloatArray) -> float:
    """How far the change of weights moves points under (T, j, 4, 4) matrices of vertices.

    The weights of a point change by amounts that sum to 0, so only what a joint does beyond the identity counts.
    """
    followed = np.flatnonzero(change.weights.any(axis=1))
    moves = np.swapaxes(matrices[:, followed, :3] - np.eye(3, 4), -1, -2)
    moving = np.abs(moves).max(axis=(2, 3)) > _STILL
    corners = np.concatenate([change.points.T, np.ones((1, len(change.points)))])
    weighted = change.weights[followed, None] * corners
    worst = 0.0
    for move, moved in zip(moves, moving, strict=True):
        # few joints move in a pose: these products stay too small for BLAS to wake its threads
        shifts = move[moved].reshape(-1, 3).T @ weighted[moved].reshape(-1, len(change.points))
        worst = max(worst, float(np.einsum("in,in->n", shifts, shifts).max(initial=0.0)))
    return float(np.sqrt(worst))
