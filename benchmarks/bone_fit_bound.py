"""How near any bones with the same weights could come, in bone_fit.py: what least squares leave, and least means.

A free affine bone has 12 unknowns, so that skinned points are linear in them and optima can be proven: they bound what
bones of any kind reach, rigid, scaled or sheared. Least means are sums of distances, minimised by least squares with
weights 1 / distance, round by round (Weiszfeld 1937).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from bone_fit_task import Task, load, session
from children import Json

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.solver import Fitted

NEAREST_MM = 3e-3  # distances count as at least this in weights
ROUNDS = 100
SETTLED = 1e-5  # of the mean: what a round must lower it by
SETTLED_BONES = 1e-4
ANY_MM = 1e-6  # threshold of fits that go on to their optimum


def bound(arrays: str) -> Json:
    """Errors in mm of free affine bones and of 9 degrees of freedom, by least squares and by least means."""
    from facepipe.core.threads import one_thread

    task = load(arrays)
    with one_thread():
        affine = _Affine(task)
        squares = affine.least_squares()
        means, least = affine.least_means(squares)
        bones = _bones(task)
    found = {"affine": squares, "affine-mean": means, **bones}
    return {"sides": {name: task.errors(points) for name, points in found.items()}, "least_mean_mm": least}


class _Affine:
    """Bones with 12 unknowns each: points are ``A X``, row i of A the weighted homogeneous rest point."""

    def __init__(self, task: Task) -> None:
        from scipy.sparse import csr_array

        self.task = task
        homogeneous = np.concatenate([task.points, np.ones((len(task.points), 1))], axis=1)
        joined = task.weights[:, :, None] * homogeneous[:, None]
        self.rows = csr_array(joined.reshape(len(task.points), -1))  # (n, 4j)

    def least_squares(self) -> Any:
        """(k, n, 3) points, the exact optimum: the targets' projection on the columns of A."""
        count = len(self.task.points)
        goals = self.task.targets.transpose(1, 0, 2).reshape(count, -1)
        unknowns = np.linalg.lstsq(self.rows.toarray(), goals, rcond=None)[0]
        return (self.rows @ unknowns).reshape(count, -1, 3).transpose(1, 0, 2)

    def least_means(self, start: Any) -> tuple[Any, float]:
        """(k, n, 3) points from others, and a mean distance in mm that no bones go below."""
        found, least = [], []
        for target, points in zip(self.task.targets, start, strict=True):
            best, below = self._least_mean(target, points)
            found.append(best)
            least.append(below)
        return np.stack(found), float(np.mean(least))

    def _least_mean(self, target: Any, points: Any) -> tuple[Any, float]:
        """Points (n, 3), and what the mean is at least.

        The bound is the dual's: any forces y of at most 1 a point that no bone feels, ``A^T y = 0``, give
        ``sum |A X - t| >= - sum y . t``. Weighted least squares ends where ``y = w (A X - t)`` is such.
        """
        from scipy.linalg import cho_factor, cho_solve

        apart = np.linalg.norm(points - target, axis=1)
        best, below = apart.mean(), 0.0
        for _ in range(ROUNDS):
            weights = 1.0 / np.maximum(apart, NEAREST_MM)
            weighted = self.rows.T.multiply(weights[None]).tocsr()
            normal = (weighted @ self.rows).toarray()
            normal[np.diag_indices_from(normal)] *= 1.0 + 1e-12
            unknowns = cho_solve(cho_factor(normal), weighted @ target)
            ahead = self.rows @ unknowns
            forces = weights[:, None] * (ahead - target)
            forces /= max(1.0, float(np.linalg.norm(forces, axis=1).max()))
            below = max(below, -float((forces * target).sum()) / len(target))
            apart = np.linalg.norm(ahead - target, axis=1)
            before, points = best, ahead if apart.mean() < best else points
            best = min(best, apart.mean())
            if before - best <= SETTLED * best:
                break
        return points, below


def _bones(task: Task) -> dict[str, Any]:
    """(k, n, 3) points of 9 degrees of freedom within the limits, least squares and least means."""
    squares = session(task, 9, rounds=0).fit_all(list(task.targets))
    means = [_least_mean(task, target, own) for target, own in zip(task.targets, squares, strict=True)]
    return {"bones": np.stack([square.points for square in squares]), "bones-mean": np.stack(means)}


def _least_mean(task: Task, target: Any, latest: Fitted) -> Any:
    """(n, 3) points: a local optimum, from that of least squares."""
    apart = np.linalg.norm(latest.points - target, axis=1)
    best, found = apart.mean(), latest.points
    for _ in range(ROUNDS):
        fit = session(task, 9, rounds=0, threshold=ANY_MM, weights=1.0 / np.maximum(apart, NEAREST_MM))
        latest = fit.fit(target, start=latest.coefficients)
        apart = np.linalg.norm(latest.points - target, axis=1)
        before = best
        if apart.mean() < best:
            best, found = apart.mean(), latest.points
        if before - best <= SETTLED_BONES * best:
            break
    return found
