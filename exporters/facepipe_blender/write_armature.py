"""Bones of an armature moved as the joints of a face have moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Skeleton

from .read_armature import joint_paths


def move_bones(armature: Any, old: Skeleton, new: Skeleton) -> None:
    """Move every bone by what lies between its joint's bind transforms in two skeletons of the same joints."""
    back = np.linalg.inv(old.transform)
    moves = {
        joint: back @ after @ np.linalg.inv(before) @ old.transform
        for joint, before, after in zip(old.joints, old.bind_transforms, new.bind_transforms, strict=True)
        if not np.array_equal(before, after)
    }
    if moves:
        _edit(armature, {name: moves[path] for name, path in joint_paths(armature).items() if path in moves})


def _edit(armature: Any, moves: Mapping[str, FloatArray]) -> None:
    layer = bpy.context.view_layer
    active = layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bones = armature.data.edit_bones
        placed = {name: move @ np.array(bones[name].matrix, np.float64) for name, move in moves.items()}
        for name, matrix in placed.items():
            bones[name].use_connect = False  # else it drags the tail of its parent along
            turn, _, other = np.linalg.svd(matrix[:3, :3])
            matrix[:3, :3] = turn @ other
            bones[name].matrix = matrix.tolist()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = active
