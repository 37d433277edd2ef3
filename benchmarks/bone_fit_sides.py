"""Sides of bone_fit.py, a process each: a face is skinned, or its bones are fitted to all its shapes.

usage: bone_fit_sides.py --side prepare ict|sample SOURCE JOINTS ARRAYS REPORT
       bone_fit_sides.py --side facepipe ARRAYS DOF REPORT
       bone_fit_sides.py --side dem-bones ARRAYS SOFT REPORT
       bone_fit_sides.py --side scipy ARRAYS DOF TARGETS REPORT
       bone_fit_sides.py --side bound ARRAYS REPORT
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from children import Json, is_side

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.rig import Rig
    from facepipe.verbs.fit_bones.bone_fit import BoneFit
    from facepipe.verbs.fit_bones.solver import Fitted

FRAME = 0.95  # the neighbouring frame: the shape at this weight
WARM = 10  # about so many targets for warm starts
SIDES = {"plain": {"rounds": 0}, "even": {}}  # least squares alone, and with the rounds that lower the largest distance
MOVES_MM = 1.0  # a point that some shape moves by more than this counts
THRESHOLD_MM = 0.1
REACH_MM, TURN, SCALES = 50.0, 0.8, (0.5, 2.0)  # limits of every joint
UPDATES = 150  # of transforms: what its compute() makes in 30 rounds of 5
NEAREST_MM = 3e-3  # distances count as at least this in weights
ROUNDS = 100
SETTLED = 1e-5  # of the mean: what a round must lower it by
SETTLED_BONES = 1e-4
ANY_MM = 1e-6  # threshold of fits that go on to their optimum


@dataclass(frozen=True)
class Clock:
    """Wall and processor time since it was made."""

    wall: float = field(default_factory=time.perf_counter)
    processor: float = field(default_factory=time.process_time)

    def read(self) -> tuple[float, float]:
        """Seconds: processor time first, which other work on the machine hardly changes."""
        return time.process_time() - self.processor, time.perf_counter() - self.wall


@dataclass(frozen=True)
class Task:
    """One set of targets for one skinned surface, in millimetres."""

    points: Any  # (n, 3) at rest
    weights: Any  # (n, j) skin weights
    joints: Any  # (j, 3) positions
    targets: Any  # (k, n, 3)

    def rig(self) -> Rig:
        """The joints side by side, as skinning decomposition has them."""
        from scipy.sparse import csr_array, hstack

        from facepipe.rig.rig import Rig, SkinWeights

        count = len(self.joints)
        rest, inverse = (np.tile(np.eye(4), (count, 1, 1)) for _ in range(2))
        rest[:, :3, 3], inverse[:, :3, 3] = self.joints, -self.joints
        return Rig(
            name="benchmark",
            mesh_names=("face",),
            mesh_offsets=np.array([0, len(self.points)]),
            points=self.points,
            shapes=(),
            targets=(),
            joints=tuple(f"bone{number:03}" for number in range(count)),
            parents=np.full(count, -1),
            rest=rest,
            inverse_bind=inverse,
            parent_world=np.eye(4),
            skinning=SkinWeights.from_sparse(
                hstack([csr_array(self.weights), csr_array((len(self.points), 1))]).tocsr()
            ),
        )

    def errors(self, found: Any) -> Json:
        """Distances in mm between (k, n, 3) points and the targets."""
        apart = np.linalg.norm(found - self.targets, axis=2)
        largest = apart.max(axis=1)
        return {
            "mean_mm": float(apart.mean()),
            "rms_mm": float(np.sqrt((apart**2).mean())),
            "max_mm": float(largest.max()),
            "mean_of_max_mm": float(largest.mean()),
        }

    def hardest(self) -> Any:
        """(k,) targets by how far they are from rest, the farthest first."""
        return np.argsort(-np.linalg.norm(self.targets - self.points, axis=2).mean(axis=1), kind="stable")


def load(arrays: str) -> Task:
    """What `prepare` wrote."""
    with np.load(arrays) as own:
        return Task(own["points"], own["weights"], own["joints"], own["targets"])


def limits(count: int, dof: int) -> tuple[Any, Any]:
    """(j, 9) limits; with 6 degrees of freedom scales are locked at 1."""
    from facepipe.rig import rest_coefficients

    lower, upper = rest_coefficients(count), rest_coefficients(count)
    for limit, sign in ((lower, -1.0), (upper, 1.0)):
        limit[:, :3], limit[:, 3:6] = sign * REACH_MM, sign * TURN
    if dof == 9:
        lower[:, 6:], upper[:, 6:] = SCALES
    return lower, upper


def session(task: Task, dof: int, **settings: Any) -> BoneFit:
    """The fit of this benchmark: rig and session, made from arrays."""
    from facepipe.verbs.fit_bones.bone_fit import BoneFit

    lower, upper = limits(len(task.joints), dof)
    return BoneFit(task.rig(), lower=lower, upper=upper, **{"threshold": THRESHOLD_MM, **settings})


def prepare(kind: str, source: str, joints: str, arrays: str) -> Json:
    """The moving surface of a face, joints spread over it, and its skin weights, as arrays in mm."""
    import tempfile
    from pathlib import Path

    import facepipe
    from facepipe import importers
    from facepipe.heads import make
    from facepipe.importers.ict import Options
    from facepipe.rig import build
    from facepipe.stage import save_parts
    from facepipe.verbs.skin.from_joints import JointSet, JointSpec
    from facepipe.verbs.skin.skin_face import SkinFace

    parts = importers.load("ict", source, Options()).parts if kind == "ict" else make(controls="bones")
    parts = _bare(parts)
    mm = 1000.0 * parts.meters_per_unit
    moving, offsets = _moving(parts, MOVES_MM / mm)
    points = build(parts).points
    places = moving[_spread(points[moving], np.linalg.norm(offsets, axis=2).max(axis=0), int(joints))]
    specs = [JointSpec(path=f"bone{number:03}", position=tuple(points[one])) for number, one in enumerate(places)]
    with tempfile.TemporaryDirectory() as folder:
        save_parts(parts, Path(folder) / "face.usdc")
        with facepipe.open(Path(folder) / "face.usdc").deriving(Path(folder) / "skinned.usdc") as face:
            SkinFace(joints=JointSet(joints=tuple(specs)))(face)
        rig = build(facepipe.open(Path(folder) / "skinned.usdc").parts())
    weights = rig.influences[moving][:, : len(places)].toarray()
    weights /= weights.sum(axis=1, keepdims=True)  # stages hold float32
    np.savez(
        arrays,
        points=points[moving] * mm,
        weights=weights,
        joints=points[places] * mm,
        targets=(points[moving] + offsets) * mm,
    )
    return {
        "points": len(moving),
        "joints": len(places),
        "targets": len(offsets),
        "influences": int((weights > 0).sum(axis=1).max()),
    }


def _bare(parts: FaceParts) -> FaceParts:
    """The face without joints."""
    from facepipe.parts import Skeleton

    meshes = tuple(replace(mesh, skin=None) for mesh in parts.meshes)
    changes = {"meshes": meshes, "skeleton": Skeleton(), "animations": (), "sliders": (), "bone_limits": None}
    return replace(parts, **changes, attach_joint=None, recipe=None)  # type: ignore[arg-type]


def _moving(parts: FaceParts, least: float) -> tuple[Any, Any]:
    """The points of the mesh with the most moving ones, numbered over the face, and their offsets (k, n, 3)."""
    names = sorted(parts.shapes)
    starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    best: tuple[Any, Any] = (np.zeros(0, dtype=np.int64), np.zeros((len(names), 0, 3)))
    for mesh, start in zip(parts.meshes, starts, strict=False):
        offsets = np.zeros((len(names), len(mesh.points), 3))
        for shape in mesh.blendshapes:
            offsets[names.index(shape.name)][shape.point_indices] = shape.offsets
        moving = np.flatnonzero(np.linalg.norm(offsets, axis=2).max(axis=0, initial=0.0) > least)
        if len(moving) > len(best[0]):
            best = moving + start, offsets[:, moving]
    return best


def _spread(points: Any, motion: Any, count: int) -> list[int]:
    """Farthest-point sampling, from the point that moves most."""
    chosen, away = [int(np.argmax(motion))], np.full(len(points), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(away)))
    return chosen


def facepipe(arrays: str, dof: str) -> Json:
    """The whole set in one call, fits of one target from rest and from a neighbouring frame, and one linear system."""
    task = load(arrays)
    _imports()
    report: Json = {}
    for name, settings in SIDES.items():
        whole, fit = _whole(task, int(dof), settings)
        report[name] = {**whole, **_cold(fit, task)}
        if name == "plain":
            report[name] |= {**_warm(fit, task), "linear_s": _linear(fit, task)}
    return report


def _imports() -> None:
    """Modules that a session needs: loaded before any clock runs, as the peer's is."""
    import scipy.linalg.lapack
    import scipy.sparse  # noqa: F401

    from facepipe.core.threads import one_thread
    from facepipe.verbs.fit_bones.bone_fit import BoneFit  # noqa: F401

    with one_thread():  # loads threadpoolctl, which looks for the libraries it controls
        pass


def _whole(task: Task, dof: int, settings: dict[str, int]) -> tuple[Json, BoneFit]:
    """All targets in one call; the clock holds what turns the task's arrays into coefficients and points."""
    clock = Clock()
    fit = session(task, dof, **settings)
    prepared, _ = clock.read()
    found = fit.fit_all(list(task.targets))
    seconds, wall = clock.read()
    errors = task.errors(np.stack([one.points for one in found]))
    return {"set_s": seconds, "set_wall_s": wall, "setup_s": prepared, **errors}, fit


def _cold(fit: BoneFit, task: Task) -> Json:
    """Each target by itself from rest, in a session that has fitted before."""
    times = []
    for target in task.targets:
        clock = Clock()
        fit.fit(target)
        times.append(clock.read())
    return _spread_of("cold", times)


def _warm(fit: BoneFit, task: Task) -> Json:
    """Fits that start where the neighbouring frame's ended."""
    times = []
    for target in task.targets[:: max(1, len(task.targets) // WARM)]:
        near = fit.fit(task.points + FRAME * (target - task.points)).coefficients
        clock = Clock()
        fit.fit(target, start=near)
        times.append(clock.read())
    return _spread_of("warm", times)


def _spread_of(name: str, times: list[tuple[float, float]]) -> Json:
    seconds, wall = np.array(times).T
    own = {"s": np.median(seconds), "slowest_s": seconds.max(), "wall_s": np.median(wall)}
    return {f"{name}_{key}": float(value) for key, value in own.items()}


def _linear(fit: BoneFit, task: Task) -> float:
    """Seconds of one boxed linear system, formed of a session's moments and solved, at rest."""
    from facepipe.geometry.bounded_least_squares import BoxedQuadratic
    from facepipe.rig import rest_coefficients
    from facepipe.verbs.fit_bones.skinning import slopes

    tree, variables, target = fit.tree, fit.variables, task.targets[task.hardest()[0]]
    rest, best = rest_coefficients(len(task.joints)), np.inf
    pairs, _ = tree.moments(task.points, fit.weights)
    for _ in range(5):
        clock = Clock()
        goal = tree.goal(target, fit.weights)
        pose = tree.pose(rest)
        gradient = variables.gradient(tree.gradient(pose, slopes(pairs, goal, pose.skinning)))
        normal = tree.normal_matrix(tree.generators(pose), pose, pairs, variables.joints)
        normal = variables.matrix(normal)
        normal[np.diag_indices_from(normal)] *= 1.0 + 1e-3
        own = variables.reduced(rest)
        BoxedQuadratic(normal).minimise(gradient, variables.lower - own, variables.upper - own)
        best = min(best, clock.read()[0])
    return best


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
        from facepipe.verbs.fit_bones.skinning import Tree

        rig, self.dof = task.rig(), dof
        self.tree = Tree(rig)
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
        return self.tree.evaluate(self.tree.pose(self._coefficients(x)).skinning)

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


def bound(arrays: str) -> Json:
    """How near any bones with the same weights could come: errors in mm by least squares and by least means.

    A free affine bone has 12 unknowns, so that skinned points are linear in them and optima can be proven: they bound
    what bones of any kind reach, rigid, scaled or sheared. Least means are sums of distances, minimised by least
    squares with weights 1 / distance, round by round (Weiszfeld 1937).
    """
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


if __name__ == "__main__":
    is_side(
        {
            "prepare": prepare,
            "facepipe": facepipe,
            "dem-bones": dem_bones,
            "scipy": scipy_bounded,
            "bound": bound,
        }
    )
