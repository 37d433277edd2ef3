"""The head's joints: where they are in a person, and how far they may move."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import asset
from facepipe.parts import BoneLimits, Skeleton


def skeleton(points: FloatArray) -> Skeleton:
    """The skeleton of a head with the points (n, 3), all joints along the axes of the world at rest."""
    head = asset()
    places = np.einsum("jk,jkc->jc", head.joint_shares, points[head.joint_points])
    world = np.tile(np.eye(4), (len(places), 1, 1))
    world[:, :3, 3] = places
    found = Skeleton(joints=head.joints, bind_transforms=world)
    rest, below = world.copy(), found.parents >= 0
    rest[below, :3, 3] -= places[found.parents[below]]
    return Skeleton(joints=head.joints, bind_transforms=world, rest_transforms=rest)


def bone_limits(joints: tuple[str, ...]) -> BoneLimits:
    """Limits that keep the face whole: 0.8 cm, 0.4 rad and 30 % for face joints, wider turns for jaw, neck and eyes."""
    lower = np.tile(np.repeat([-0.8, -0.4, 0.7], 3), (len(joints), 1))
    upper = np.tile(np.repeat([0.8, 0.4, 1.3], 3), (len(joints), 1))
    for i, joint in enumerate(joints):
        name = joint.rpartition("/")[2]
        if name in ("root", "neck", "head"):
            lower[i, :3], upper[i, :3] = 0.0, 0.0
            lower[i, 3:6], upper[i, 3:6] = -0.7, 0.7
        elif name == "jaw":
            lower[i, 3], upper[i, 3] = -0.05, 0.45
        elif name.startswith(("eye", "lid")):
            lower[i, 3:6], upper[i, 3:6] = -0.6, 0.6
    return BoneLimits(lower=lower, upper=upper)
