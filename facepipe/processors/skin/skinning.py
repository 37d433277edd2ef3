"""A skeleton and weights, on the way to a face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.geometry.heat_weights import influences
from facepipe.parts import Animation, FaceParts, Skeleton, Skin
from facepipe.processors.skin.report import TransferReport
from facepipe.processors.skin.surface import Surface
from facepipe.rig.animation import local_transforms
from facepipe.rig.build_rig import mesh_spaces
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.stage.differences import same


@dataclass(frozen=True, kw_only=True)
class Skinning:
    """A skeleton and weights (m, j) of the sewn points of a face, before they are cut to few influences."""

    skeleton: Skeleton
    weights: FloatArray
    transfer: TransferReport | None = None
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
    return replace(made, skeleton=skeleton, weights=made.weights[:, order])


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
    bind[:, :3, 3] = positions @ to_skeleton[:3, :3].T + to_skeleton[:3, 3]
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
