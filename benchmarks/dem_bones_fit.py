"""The side of py-dem-bones in bone_fit.py."""

from __future__ import annotations

import numpy as np
from bone_fit_task import Clock, load
from children import Json

UPDATES = 150  # of transforms: what its compute() makes in 30 rounds of 5


def dem_bones(arrays: str, soft: str) -> Json:
    """Transforms for the same weights; `soft` is its constraint of translations, 0 for none.

    The clock holds what turns the task's arrays into transforms: laying the arrays out as it takes them, handing them
    over, its updates, and reading the transforms.
    """
    from py_dem_bones import DemBones

    task = load(arrays)
    count, frames, bones = len(task.points), len(task.targets), len(task.joints)
    clock = Clock()
    solver = DemBones()
    solver.nV, solver.nF, solver.nS, solver.nB = count, frames, 1, bones
    solver.fStart, solver.subjectID = np.array([0, frames], np.int32), np.zeros(frames, np.int32)
    solver.u = np.ascontiguousarray(task.points.T)
    solver.v = np.ascontiguousarray(task.targets.transpose(0, 2, 1).reshape(3 * frames, count))
    solver.fv = []  # its smoothness serves weights alone
    solver.set_weights(np.ascontiguousarray(task.weights.T))
    solver.nTransIters, solver.transAffine = UPDATES, float(soft)
    prepared, _ = clock.read()
    solver.computeTranformations()
    blocks = np.asarray(solver.m).reshape(frames, 4, bones, 4).transpose(0, 2, 1, 3)[:, :, :3]
    seconds, wall = clock.read()
    found = []
    for frame in blocks:
        own = (task.weights @ frame.reshape(bones, 12)).reshape(count, 3, 4)
        found.append(np.einsum("nij,nj->ni", own[:, :, :3], task.points) + own[:, :, 3])
    return {"set_s": seconds, "set_wall_s": wall, "setup_s": prepared, **task.errors(np.stack(found))}
