"""The head's joints: where they are in a person, and how far they may move."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import asset
from facepipe.parts import Skeleton


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
