"""A skeleton and weights, on the way to a face, and the report of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reports import Report
from facepipe.geometry.heat_weights import influences
from facepipe.geometry.vectors import transformed
from facepipe.parts import Animation, BoneLimits, FaceParts, Skeleton, Skin
from facepipe.rig.animation import local_transforms
from facepipe.rig.rig import mesh_spaces
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.stage.values import same
from facepipe.verbs.skin.surface import Surface


@dataclass(frozen=True, kw_only=True)
class FitReport:
    """How well skinning alone reproduces the face's shapes, over all points that any of them moves, in millimetres."""

    shapes: int
    points: int
    rms_before_mm: float  # weights as made, transforms fitted
    rms_after_mm: float
    max_before_mm: float
    max_after_mm: float


@dataclass(frozen=True, kw_only=True)
class TransferReport:
    """How the skeleton came over."""

    source: str
    same_topology: bool  # every point has the weights of its own
    landmarks_mm: float  # largest distance of a warped landmark from this face's
    surface_mm: Mapping[
        str, float
    ]  # mean, RMS, p95, max: main part from the warped source, of one topology from the points
    eyeballs: int  # paired, and used as landmarks
    parts: Mapping[str, tuple[str, ...]]  # mesh of loose parts -> meshes of the source that they took weights from


@dataclass(frozen=True, kw_only=True)
class LearntReport:
    """How near bone coefficients come to the faces that joints were learnt from, over all points, in millimetres."""

    faces: int
    apart_mm: float  # points of theirs from the face's own, on average
    mean_mm: float  # what coefficients leave
    p95_mm: float
    max_mm: float
    translation_mm: float  # most that one needs in a channel
    rotation: float  # radians
    scale: tuple[float, float]  # least and most


@dataclass(frozen=True, kw_only=True)
class SkinReport(Report):
    """What was authored."""

    joints: int
    influences: int  # most that a point has
    meshes: Mapping[str, int]  # mesh -> most influences of its points
    weightless: tuple[str, ...]  # joints that move no point
    rigid: Mapping[str, str] = field(default_factory=dict)  # mesh that one joint moves whole -> joint
    largest_step: float  # largest difference of a weight between the two ends of an edge
    largest_step_per_mm: float  # the same over the length of the edge, edges below 1 mm counted as 1 mm
    transfer: TransferReport | None = None
    fit: FitReport | None = None
    learnt: LearntReport | None = None


def steps(surface: Surface, weights: FloatArray) -> tuple[float, float]:
    """Largest difference of weights (m, j) over an edge, and over an edge's length in millimetres."""
    if not len(surface.edges):
        return 0.0, 0.0
    a, b = surface.edges.T
    change = np.abs(weights[a] - weights[b]).max(axis=1)
    length = np.linalg.norm(surface.points[a] - surface.points[b], axis=1)
    return float(change.max()), float((change / np.maximum(length, 1.0)).max())


@dataclass(frozen=True, kw_only=True)
class Skinning:
    """A skeleton and weights (m, j) of the sewn points of a face, before they are cut to few influences."""

    skeleton: Skeleton
    weights: FloatArray
    transfer: TransferReport | None = None
    learnt: LearntReport | None = None
    limits: BoneLimits | None = None  # None: what the face has
    warnings: tuple[str, ...] = ()


def check_joints(surface: Surface, parts: FaceParts, joints: tuple[str, ...]) -> None:
    """:raises InputError: the face has other joints; their order doesn't count"""
    old = parts.skeleton.joints
    if old and set(old) != set(joints):
        one = next(name for name in (*old, *joints) if (name in old) != (name in joints))
        what = f"has {len(old)} joints, expected a face without, or with the same ones"
        raise InputError(surface.where, f"{what} ('{one[:80]}' is on one side alone)")


def arranged(made: Skinning, joints: Sequence[str]) -> Skinning:
    """The same with its joints in the order of those that the face has; as it is where that has none."""
    old = made.skeleton
    if not joints or old.joints == tuple(joints):
        return made
    order = [old.joints.index(joint) for joint in joints]
    binds, rests = old.bind_transforms[order], old.rest_transforms[order]
    names = tuple(old.names[i] for i in order) if old.joint_names else ()
    skeleton = replace(old, joints=tuple(joints), joint_names=names, bind_transforms=binds, rest_transforms=rests)
    limits = made.limits and BoneLimits(lower=made.limits.lower[order], upper=made.limits.upper[order])
    return replace(made, skeleton=skeleton, weights=made.weights[:, order], limits=limits)


def skinned(parts: FaceParts, surface: Surface, skeleton: Skeleton, weights: FloatArray) -> FaceParts:
    """The face with the skeleton and the weights (m, j), whose rows have few influences each.

    Its animations keep what they do relative to rest.
    """
    meshes, start = [], 0
    for mesh, space in zip(parts.meshes, mesh_spaces(parts), strict=True):
        rows = weights[surface.group[start : start + len(mesh.points)]]
        width = max(1, int((rows > 0).sum(axis=1).max(initial=0)))
        indices, values = influences(rows, width)
        skin = Skin(joint_indices=indices, joint_weights=values, geom_bind_transform=space)
        meshes.append(replace(mesh, skin=skin))
        start += len(mesh.points)
    animations = tuple(_carried(animation, parts.skeleton, skeleton) for animation in parts.animations)
    return replace(parts, meshes=tuple(meshes), skeleton=skeleton, animations=animations)


def _carried(animation: Animation, old: Skeleton, new: Skeleton) -> Animation:
    """The animation, its joint transforms relative to the rest of `new` as they were to that of `old`."""
    if not animation.joints or same(old.rest_transforms, new.rest_transforms):
        return animation
    if animation.coefficients is not None:
        return replace(animation, translations=None, rotations=None, scales=None)
    local = local_transforms(old, animation)
    rows = [new.joints.index(joint) for joint in animation.joints]
    try:
        undone = np.linalg.inv(np.asarray(old.rest_transforms, np.float64)[rows])
    except np.linalg.LinAlgError:
        raise TopologyError(f"{old.name} -> restTransforms", "singular, expected invertible ones") from None
    trs = decompose(new.rest_transforms[rows] @ undone @ local)
    return replace(animation, translations=trs.translation, rotations=trs.rotation, scales=trs.scale)


def skeleton_of(old: Skeleton, paths: tuple[str, ...], positions: FloatArray, rotations: FloatArray) -> Skeleton:
    """The skeleton `old` with other joints.

    :param positions: (j, 3) in the world, stage units
    :param rotations: (j, 4) quaternions x y z w relative to the parent's axes; roots: to the skeleton's
    """
    plain = Skeleton(joints=paths)
    to_skeleton = np.linalg.inv(np.asarray(old.transform, np.float64))
    bind = np.tile(np.eye(4), (len(paths), 1, 1))
    turns = rotation_matrices(rotations)
    for i, parent in enumerate(plain.parents):
        bind[i, :3, :3] = turns[i] if parent < 0 else bind[parent, :3, :3] @ turns[i]
    bind[:, :3, 3] = transformed(positions, to_skeleton)
    return with_binds(old, paths, bind)


def with_binds(old: Skeleton, paths: tuple[str, ...], bind: FloatArray) -> Skeleton:
    """The skeleton `old` with other joints of bind transforms (j, 4, 4) in skeleton space, at rest as bound.

    Joints of the paths that are there keep their names.
    """
    plain, known = Skeleton(joints=paths), dict(zip(old.joints, old.names, strict=True))
    names = [known.get(path, leaf) for path, leaf in zip(paths, plain.names, strict=True)]
    parents = plain.parents
    inverse = np.linalg.inv(bind)
    rest = np.array([bind[i] if p < 0 else inverse[p] @ bind[i] for i, p in enumerate(parents)]).reshape(-1, 4, 4)
    made = Skeleton(name=old.name, joints=paths, bind_transforms=bind, rest_transforms=rest, transform=old.transform)
    return made.called(names)
