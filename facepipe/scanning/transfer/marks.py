"""What a template that lies on a head says of the head's points: soft regions, landmarks and the anchor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.closest_points import closest_places, place_shares

_NEAR = 30  # points of the head that may stand for a landmark: enough that no two take the same


def carried_masks(
    masks: Mapping[str, FloatArray], points: FloatArray, triangles: IntArray, places: FloatArray
) -> dict[str, FloatArray]:
    """Region -> (m,) mask at `places` (m, 3): that of the template's surface where it is nearest. They sum to 1 where
    those of the template do.

    :param masks: region -> (n,) mask of the template
    :param points: (n, 3) of the template, lying on the head
    """
    nearest = closest_places(places, points, triangles)
    corners, shares = triangles[nearest.triangles], place_shares(nearest, points, triangles)
    return {name: np.asarray((mask[corners] * shares).sum(axis=1)) for name, mask in masks.items()}


def own_points(marks: FloatArray, places: FloatArray) -> IntArray:
    """(l,) the points of `places` (m, 3) that stand for `marks` (l, 3), no two the same: those that are nearest in all.

    On coarse meshes one point is the nearest to two landmarks; either would then move the other's.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import cKDTree

    count = min(max(_NEAR, len(marks)), len(places))
    near = np.unique(cKDTree(places).query(marks, k=np.arange(1, count + 1))[1])
    distances = np.linalg.norm(marks[:, None] - places[near][None], axis=2)
    rows, columns = linear_sum_assignment(distances**2)
    chosen = np.full(len(marks), -1)
    chosen[rows] = near[columns]
    return chosen
