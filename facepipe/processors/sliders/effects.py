"""How far each bone coefficient moves a face."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig import Rig, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_derivatives


def channel_effects(rig: Rig) -> FloatArray:
    """(m, 9) the largest motion of a point by a unit of each coefficient, near rest.

    A joint's motion takes all points that hang at it or at joints below it, each as much as these weigh. Exact where
    the rest pose is the bind pose.
    """
    count = len(rig.joints)
    worlds = rig.joint_worlds(rig.rest)
    motions = worlds[:, None] @ coefficient_derivatives(rest_coefficients(count)) @ np.linalg.inv(worlds)[:, None]
    points = np.column_stack([rig.evaluate(), np.ones(len(rig.points))])
    weights = np.asarray(rig.influences[:, :count].todense())
    for joint in range(count - 1, -1, -1):  # children come after their parents
        if rig.parents[joint] >= 0:
            weights[:, rig.parents[joint]] += weights[:, joint]
    effects = np.zeros((count, 9))
    for joint in range(count):
        held = np.flatnonzero(np.abs(weights[:, joint]) > 0)
        moved = np.einsum("cij,nj->cni", motions[joint][:, :3], points[held])
        lengths = np.linalg.norm(moved, axis=2) * np.abs(weights[held, joint])
        effects[joint] = lengths.max(axis=1, initial=0.0)
    return effects
