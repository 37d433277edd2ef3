"""Joints carried along with the points that hang at them."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import fit_similarities, fit_similarity
from facepipe.geometry.vectors import group_sums
from facepipe.parts import FaceParts, Skeleton
from facepipe.processors.blend.rigs import blend_skeletons
from facepipe.rig import build

_STILL = 1e-9  # of the face's size: rounding
_FAR = 3.0  # spreads of its points that a joint may be away from them and still turn about them


def carried_skeleton(parts: FaceParts, moved: FloatArray) -> Skeleton:
    """The skeleton of a face whose points have moved to `moved` (n, 3), in skeleton space.

    Each joint goes to where the similarity that fits its points best, by their skin weights, takes it. One that lies
    far from them goes with their middle, turned and scaled as the whole face; one without points goes with the whole
    face. Joints keep their axes, and their rest pose stays to the bind pose what it is.

    :raises TopologyError: a singular transform
    """
    skeleton = parts.skeleton
    if not skeleton.joints:
        return skeleton
    rig, count = build(parts), len(skeleton.joints)
    binds = np.asarray(skeleton.bind_transforms, np.float64)
    places, whole = binds[:, :3, 3], fit_similarity(rig.points, moved)
    held = rig.influences[:, :count].tocoo()
    joints, of_point = np.unique(held.col, return_inverse=True)  # those with points
    positions = whole.apply(places)
    if len(joints):
        before, after = rig.points[held.row], moved[held.row]
        fitted = fit_similarities(before, after, of_point, weights=held.data)
        total = group_sums(of_point, held.data[:, None], len(joints))
        middle, then = (group_sums(of_point, one * held.data[:, None], len(joints)) / total for one in (before, after))
        apart = ((before - middle[of_point]) ** 2).sum(axis=1) * held.data
        spread = np.sqrt(group_sums(of_point, apart[:, None], len(joints)) / total)
        away = places[joints] - middle
        near = np.linalg.norm(away, axis=1, keepdims=True) <= _FAR * spread
        along = then + whole.scale * away @ whole.rotation.T
        positions[joints] = np.where(near, fitted.apply(places[joints], np.arange(len(joints))), along)
    if np.abs(positions - places).max() <= _STILL * np.ptp(rig.points, axis=0).max(initial=0.0):
        return skeleton
    return blend_skeletons([skeleton], binds[None], positions, np.ones((count, 1)))
