"""The side of scipy's bounded solvers in bone_fit.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from bone_fit_task import Clock, Task, limits, load, session
from children import Json


def scipy_bounded(arrays: str, dof: str, targets: str) -> Json:
    """scipy's bounded solvers on the hardest targets, with the analytic Jacobian as a sparse matrix."""
    from scipy.optimize import least_squares, lsq_linear

    task = load(arrays)
    chosen = task.hardest()[: int(targets)]
    some = replace(task, targets=task.targets[chosen])
    system = _System(task, int(dof))
    seconds, linear, found, ours = [], [], [], []
    fit = session(task, int(dof), rounds=0)
    low, high = system.low, system.high
    for target in some.targets:
        clock = Clock()
        done = least_squares(
            system.residual, system.rest, system.jacobian, (low, high), "trf", x_scale="jac", args=(target,)
        )
        seconds.append(clock.read()[0])
        found.append(system.points(done.x))
        clock = Clock()
        jacobian, residual = system.jacobian(system.rest, target), system.residual(system.rest, target)
        lsq_linear(jacobian, -residual, (low - system.rest, high - system.rest), method="trf")
        linear.append(clock.read()[0])
        clock = Clock()
        ours.append((fit.fit(target).points, clock.read()[0]))
    return {
        "targets": len(chosen),
        "cold_s": float(np.mean(seconds)),
        "set_s": float(np.mean(seconds)) * len(task.targets),  # extrapolated
        "linear_s": float(np.mean(linear)),
        "ours_cold_s": float(np.mean([one for _, one in ours])),
        **some.errors(np.stack(found)),
        "ours": some.errors(np.stack([points for points, _ in ours])),
    }


class _System:
    """Residuals and sparse Jacobian over the coefficients that may move, as scipy takes them."""

    def __init__(self, task: Task, dof: int) -> None:
        from scipy.sparse import csr_array

        from facepipe.rig import rest_coefficients
        from facepipe.verbs.fit_bones.skinning import SkinnedPoints, Tree

        rig, self.dof = task.rig(), dof
        self.tree, self.skin = Tree(rig), SkinnedPoints(rig)
        pick = (slice(None), slice(0, dof))
        lower, upper = limits(len(task.joints), dof)
        self.low, self.high = lower[pick].ravel(), upper[pick].ravel()
        self.rest = rest_coefficients(len(task.joints))[pick].ravel()
        own = csr_array(task.weights)
        self._point = np.repeat(np.arange(len(task.points)), np.diff(own.indptr))
        self._joint, self._weight = own.indices, own.data
        self._rest_points = np.concatenate([task.points, np.ones((len(task.points), 1))], axis=1)
        rows = (3 * self._point[:, None, None] + np.arange(3)[:, None]) + np.zeros((1, 1, dof), dtype=np.int64)
        columns = (dof * self._joint[:, None, None] + np.arange(dof)) + np.zeros((1, 3, 1), dtype=np.int64)
        self._places = rows.ravel(), columns.ravel()
        self._shape = (3 * len(task.points), dof * len(task.joints))

    def _coefficients(self, x: Any) -> Any:
        from facepipe.rig import rest_coefficients

        full = rest_coefficients(len(x) // self.dof)
        full[:, : self.dof] = x.reshape(-1, self.dof)
        return full

    def points(self, x: Any) -> Any:
        """(n, 3)"""
        return self.skin.evaluate(self.tree.pose(self._coefficients(x)).skinning, self.tree.parent_world)

    def residual(self, x: Any, target: Any) -> Any:
        """(3n,)"""
        return (self.points(x) - target).ravel()

    def jacobian(self, x: Any, target: Any) -> Any:
        """(3n, dof j)"""
        from scipy.sparse import csr_array

        pose = self.tree.pose(self._coefficients(x))
        change = (self.tree.generators(pose) @ pose.skinning[:, None])[:, : self.dof, :3]  # (j, dof, 3, 4)
        moved = np.einsum("ecik,ek->eic", change[self._joint], self._rest_points[self._point] * self._weight[:, None])
        return csr_array((moved.ravel(), self._places), shape=self._shape)
