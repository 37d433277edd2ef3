"""The least displacements of a surface that meet inequalities on some of its points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.gradient_system import GradientSystem

_SOFT = 1e-3  # of the mean compliance, added to each: neighbours that ask for more than a smooth push gives
_CHANGES = 20  # of the active set
_MOST = 400  # demands at once, those that need most; the solve is dense, and a push that meets these meets most others


class Demands(NamedTuple):
    """Inequalities ``sum_s way_s . u(point_s) >= need`` on displacements u."""

    points: IntArray  # (m, s); -1 for none
    ways: FloatArray  # (m, s, 3)
    needs: FloatArray  # (m,)


def least_push(system: GradientSystem, pose: FloatArray, free: BoolArray, demands: Demands, reach: float) -> FloatArray:
    """(n, 3) displacements of the points that are `free` (n,) and lie within `reach` of those of the demands.

    With K the bi-Laplacian of the points around, held still at their border, and N the rows of the demands, the least
    ``u K u`` with ``N u >= b`` is ``K^-1 N^T y`` of the least ``y A y / 2 - b y`` over y >= 0, ``A = N K^-1 N^T``: a
    column of K^-1 for each point that is asked for, and no more. Demands on points that aren't free are left out.

    :param pose: (n, 3)
    """
    from scipy.spatial import cKDTree

    asked = (demands.points >= 0) & free[demands.points]
    free_ways = np.where(asked[..., None], demands.ways, 0.0)
    some = np.flatnonzero(free_ways.any(axis=(1, 2)))
    some = np.sort(some[np.argsort(-demands.needs[some], kind="stable")[:_MOST]])
    points, ways, needs, pushes = demands.points[some], free_ways[some], demands.needs[some], np.zeros(pose.shape)
    if not len(needs):
        return pushes
    involved = np.unique(points[asked[some]])
    among = np.flatnonzero(free)
    near = np.zeros(len(free), bool)
    far, _ = cKDTree(pose[involved]).query(pose[among], distance_upper_bound=reach)
    near[among[np.isfinite(far)]] = True
    moving = system.moving(near)
    columns = moving.compliance(involved)  # (p, i)
    place = np.zeros(len(free) + 1, np.int64)
    place[involved] = np.arange(len(involved))
    # (i, m) each coordinate's part of N^T: the same system holds for all three
    rows = [np.zeros((len(involved), len(needs))) for _ in range(3)]
    for slot in range(points.shape[1]):
        for axis, one in enumerate(rows):
            np.add.at(one, (place[points[:, slot]], np.arange(len(needs))), ways[:, slot, axis])
    between = columns[np.searchsorted(moving.points, involved)]
    matrix = sum(one.T @ between @ one for one in rows)
    forces = _least(np.asarray(matrix), needs)
    pushes[moving.points] = columns @ np.stack([one @ forces for one in rows], axis=1)
    return pushes


def _least(matrix: FloatArray, needs: FloatArray) -> FloatArray:
    """(m,) y >= 0 of the least ``y A y / 2 - b y``, by an active set."""
    soft = matrix + np.eye(len(matrix)) * (_SOFT * np.trace(matrix) / len(matrix))
    active, forces = np.ones(len(needs), bool), np.zeros(len(needs))
    for _ in range(_CHANGES):
        forces[:] = 0.0
        forces[active] = np.linalg.solve(soft[np.ix_(active, active)], needs[active])
        if (forces < 0).any():
            active &= forces > 0
            continue
        missing = ~active & (soft @ forces < needs)
        if not missing.any():
            break
        active |= missing
    return np.maximum(forces, 0.0)
