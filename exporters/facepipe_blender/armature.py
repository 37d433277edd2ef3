"""An armature of Blender as the skeleton of a face, in the space of the armature."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import identifier, unique_identifiers
from facepipe.parts import Skeleton


def joint_paths(armature: Any) -> dict[str, str]:
    """Bone name -> joint path, parents first."""
    bones: list[Any] = []
    left = [bone for bone in reversed(armature.data.bones) if bone.parent is None] if armature is not None else []
    while left:
        bones.append(left.pop())
        left += reversed(list(bones[-1].children))
    paths: dict[str, str] = {}
    for bone, name in zip(bones, unique_identifiers(bone.name for bone in bones), strict=True):
        paths[bone.name] = f"{paths[bone.parent.name]}/{name}" if bone.parent else name
    return paths


def bone_matrices(armature: Any) -> dict[str, FloatArray]:
    """Joint path -> (4, 4) matrix at rest in armature space."""
    if armature is None:
        return {}
    bones = armature.data.bones
    return {path: np.array(bones[name].matrix_local, dtype=np.float64) for name, path in joint_paths(armature).items()}


def read_skeleton(armature: Any) -> Skeleton:
    """The bones at rest; a skeleton without joints for None."""
    if armature is None:
        return Skeleton()
    if armature.data.is_editmode:
        armature.update_from_editmode()
    matrices = bone_matrices(armature)
    name = identifier(armature.name, "Skeleton")
    made = skeleton_at_rest(name, tuple(matrices), np.array(list(matrices.values())).reshape(-1, 4, 4))
    return made.called(tuple(joint_paths(armature)))


def skeleton_at_rest(name: str, joints: tuple[str, ...], world: FloatArray) -> Skeleton:
    """The skeleton whose joints rest where they are bound.

    :param world: (j, 4, 4) joint matrices
    """
    bare = Skeleton(joints=joints)
    rest = [
        np.linalg.solve(world[parent], matrix) if parent >= 0 else matrix
        for parent, matrix in zip(bare.parents, world, strict=True)
    ]
    return Skeleton(name=name, joints=joints, bind_transforms=world, rest_transforms=np.array(rest).reshape(-1, 4, 4))


def move_bones(armature: Any, old: Skeleton, new: Skeleton) -> None:
    """Move every bone by what lies between its joint's bind transforms in two skeletons of the same joints."""
    back = np.linalg.inv(old.transform)
    moves = {
        joint: back @ after @ np.linalg.inv(before) @ old.transform
        for joint, before, after in zip(old.joints, old.bind_transforms, new.bind_transforms, strict=True)
        if not np.array_equal(before, after)
    }
    if not moves:
        return
    of_bones = {name: moves[path] for name, path in joint_paths(armature).items() if path in moves}
    layer = bpy.context.view_layer
    active = layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bones = armature.data.edit_bones
        placed = {name: move @ np.array(bones[name].matrix, np.float64) for name, move in of_bones.items()}
        for name, matrix in placed.items():
            bones[name].use_connect = False  # else it drags the tail of its parent along
            turn, _, other = np.linalg.svd(matrix[:3, :3])
            matrix[:3, :3] = turn @ other  # the nearest rotation: bones hold no scale
            bones[name].matrix = matrix.tolist()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = active
