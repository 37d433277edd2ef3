"""What the bone fits of bone_fit.py are given: the moving surface of a face with skin weights, and targets."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from children import Json

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.rig import Rig
    from facepipe.verbs.fit_bones.bone_fit import BoneFit

MOVES_MM = 1.0  # a point that some shape moves by more than this counts
THRESHOLD_MM = 0.1
REACH_MM, TURN, SCALES = 50.0, 0.8, (0.5, 2.0)  # limits of every joint


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
