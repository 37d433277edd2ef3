"""A face as a clip of it plays, by the rig."""

from __future__ import annotations

import numpy as np

from facepipe.parts import FaceParts
from facepipe.rig.animation import at_times, local_transforms
from facepipe.rig.rig import build


def posed(parts: FaceParts, clip: str, seconds: float) -> np.ndarray:
    """(n, 3) world points of all meshes at a time of a clip."""
    found = next(one for one in parts.animations if one.name == clip)
    animation = at_times(parts.skeleton, found, np.array([seconds]))
    rig, local = build(parts), np.array(parts.skeleton.rest_transforms)
    for joint, matrix in zip(animation.joints, local_transforms(parts.skeleton, animation)[0], strict=True):
        local[parts.skeleton.joints.index(joint)] = matrix
    weights = animation.shape_weights
    shown = {} if weights is None else dict(zip(animation.shapes, map(float, weights[0]), strict=True))
    return np.asarray(rig.evaluate(shown, joint_transforms=local))
