"""Child of bone_fit.py: skins a face, or fits its bones to all its shapes on one side; reports times and errors.

usage: facepipe_bone_fit.py prepare ict|sample SOURCE JOINTS ARRAYS REPORT
       facepipe_bone_fit.py facepipe ARRAYS DOF REPORT
       facepipe_bone_fit.py dem-bones ARRAYS SOFT REPORT
       facepipe_bone_fit.py scipy ARRAYS DOF TARGETS REPORT
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from children import Json, write_report

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.processors.fit_bones.session import BoneFit
    from facepipe.rig import Rig

MOVES_MM = 1.0  # a point that some shape moves by more than this counts
THRESHOLD_MM = 0.1
REACH_MM, TURN, SCALES = 50.0, 0.8, (0.5, 2.0)  # limits of every joint
FRAME = 0.95  # the neighbouring frame: the shape at this weight
WARM = 10  # about so many targets for warm starts
UPDATES = 150  # of py-dem-bones' transforms: what its compute() makes in 30 rounds of 5


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

        from facepipe.rig import Rig

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
            influences=hstack([csr_array(self.weights), csr_array((len(self.points), 1))]).tocsr(),
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


def prepare(kind: str, source: str, joints: str, arrays: str) -> Json:
    """The moving surface of a face, joints spread over it, and its skin weights, as arrays in mm."""
    import tempfile
    from pathlib import Path

    import facepipe
    from facepipe import importers
    from facepipe.importers.ict import Options
    from facepipe.processors.skin.joints_file import JointSet, JointSpec
    from facepipe.processors.skin.skin_face import SkinFace
    from facepipe.rig import build
    from facepipe.stage import save_parts

    if kind == "ict":
        parts = importers.load("ict", source, Options()).parts
    else:
        parts = facepipe.open(sorted(Path(source).glob("head*.usdz"))[0]).parts()
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
    names = sorted({shape.name for mesh in parts.meshes for shape in mesh.blendshapes})
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
    """The fit of this benchmark."""
    from facepipe.processors.fit_bones.session import BoneFit

    lower, upper = limits(len(task.joints), dof)
    return BoneFit(task.rig(), lower=lower, upper=upper, threshold=THRESHOLD_MM, **settings)


def facepipe(arrays: str, dof: str) -> Json:
    """Least squares alone, then with the rounds that lower the largest distance; warm starts; one linear system."""
    task = _load(arrays)
    import scipy.linalg
    import scipy.sparse  # noqa: F401  (else the session would)

    start = time.perf_counter()
    plain = session(task, int(dof), rounds=0)
    prepared = time.perf_counter() - start
    report: Json = {"session_s": prepared, "linear_s": _linear(plain, task)}
    for name, fit in (("plain", plain), ("even", session(task, int(dof)))):
        seconds, found = [], []
        for target in task.targets:
            start = time.perf_counter()
            found.append(fit.fit(target))
            seconds.append(time.perf_counter() - start)
        report[name] = {
            "set_s": prepared + sum(seconds),
            "cold_s": float(np.median(seconds)),
            "cold_slowest_s": max(seconds),
            "seconds": seconds,
            **task.errors(np.stack([one.points for one in found])),
        }
    report["plain"] |= _warm(plain, task)
    return report


def _warm(fit: BoneFit, task: Task) -> Json:
    """Fits that start where the neighbouring frame's ended."""
    seconds = []
    for target in task.targets[:: max(1, len(task.targets) // WARM)]:
        near = fit.fit(task.points + FRAME * (target - task.points)).coefficients
        start = time.perf_counter()
        fit.fit(target, start=near)
        seconds.append(time.perf_counter() - start)
    return {"warm_s": float(np.median(seconds)), "warm_slowest_s": max(seconds)}


def _linear(fit: BoneFit, task: Task) -> float:
    """Seconds of one boxed linear system, formed and solved, at rest."""
    from facepipe.geometry.boxed_qp import solve_boxed
    from facepipe.rig import rest_coefficients

    skin, tree, target, best = fit.skin, fit.tree, task.targets[_hardest(task)[0]], np.inf
    rest = rest_coefficients(len(task.joints))
    moments = skin.moments(target, fit.weights, tree.parent_world)
    for _ in range(5):
        start = time.perf_counter()
        pose = tree.pose(rest)
        generators = tree.generators(pose)
        gradient = tree.gradient(pose, moments.gradient(pose.skinning))[fit.free].ravel()
        normal = tree.normal_matrix(generators, pose, moments.pairs, fit.free)
        normal[np.diag_indices_from(normal)] *= 1.0 + 1e-3
        low, high = ((limit - rest)[fit.free].ravel() for limit in (fit.lower, fit.upper))
        solve_boxed(normal, gradient, low, high)
        best = min(best, time.perf_counter() - start)
    return best


def dem_bones(arrays: str, soft: str) -> Json:
    """Transforms of py-dem-bones for the same weights; `soft` is its constraint of translations, 0 for none."""
    from py_dem_bones import DemBones

    task = _load(arrays)
    count, frames, bones = len(task.points), len(task.targets), len(task.joints)
    solver = DemBones()
    solver.nV, solver.nF, solver.nS, solver.nB = count, frames, 1, bones
    solver.fStart, solver.subjectID = np.array([0, frames], np.int32), np.zeros(frames, np.int32)
    solver.u = np.ascontiguousarray(task.points.T)
    solver.v = np.ascontiguousarray(task.targets.transpose(0, 2, 1).reshape(3 * frames, count))
    solver.fv = []  # its smoothness serves weights alone
    solver.set_weights(np.ascontiguousarray(task.weights.T))
    solver.nTransIters, solver.transAffine = UPDATES, float(soft)
    start = time.perf_counter()
    solver.computeTranformations()
    seconds = time.perf_counter() - start
    blocks = np.asarray(solver.m).reshape(frames, 4, bones, 4).transpose(0, 2, 1, 3)[:, :, :3]
    found = []
    for frame in blocks:
        own = (task.weights @ frame.reshape(bones, 12)).reshape(count, 3, 4)
        found.append(np.einsum("nij,nj->ni", own[:, :, :3], task.points) + own[:, :, 3])
    return {"set_s": seconds, "cold_s": seconds / frames, **task.errors(np.stack(found))}


def scipy_bounded(arrays: str, dof: str, targets: str) -> Json:
    """scipy's bounded solvers on the hardest targets, with the analytic Jacobian as a sparse matrix."""
    from scipy.optimize import least_squares, lsq_linear

    task = _load(arrays)
    chosen = _hardest(task)[: int(targets)]
    some = replace(task, targets=task.targets[chosen])
    system = _System(task, int(dof))
    seconds, linear, found, ours = [], [], [], []
    fit = session(task, int(dof), rounds=0)
    low, high = system.low, system.high
    for target in some.targets:
        start = time.perf_counter()
        done = least_squares(
            system.residual, system.rest, system.jacobian, (low, high), "trf", x_scale="jac", args=(target,)
        )
        seconds.append(time.perf_counter() - start)
        found.append(system.points(done.x))
        start = time.perf_counter()
        jacobian, residual = system.jacobian(system.rest, target), system.residual(system.rest, target)
        lsq_linear(jacobian, -residual, (low - system.rest, high - system.rest), method="trf")
        linear.append(time.perf_counter() - start)
        start = time.perf_counter()
        ours.append((fit.fit(target).points, time.perf_counter() - start))
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

        from facepipe.processors.fit_bones.moments import SkinnedPoints
        from facepipe.processors.fit_bones.tree import Tree
        from facepipe.rig import rest_coefficients

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


def _hardest(task: Task) -> Sequence[int]:
    """Targets by how far they are from rest, the farthest first."""
    return list(np.argsort(-np.linalg.norm(task.targets - task.points, axis=2).mean(axis=1), kind="stable"))


def _load(arrays: str) -> Task:
    with np.load(arrays) as own:
        return Task(own["points"], own["weights"], own["joints"], own["targets"])


def main(arguments: list[str]) -> None:
    """Run the verb, report to the last argument."""
    verb, *rest, report = arguments
    verbs: dict[str, Callable[..., Json]] = {
        "prepare": prepare,
        "facepipe": facepipe,
        "dem-bones": dem_bones,
        "scipy": scipy_bounded,
    }
    write_report(report, verbs[verb](*rest))


if __name__ == "__main__":
    main(sys.argv[1:])
