"""GLBs, imported at the importer's defaults and posed: REQUEST ANSWER; the request is that of js/poses.mjs.

The answer has `names i` of a file's meshes; `points i j` (vertices) and `positions i j` (poses, vertices, 3) of each.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from session import ARGUMENTS, Matrix, Quaternion, Vector, answer, bpy, np, world_points

TO_BLENDER = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # Y up to Z up
Joints = Mapping[str, Sequence[float]]


def local(trs: Sequence[float]) -> Matrix:
    """The matrix of a node."""
    return Matrix.LocRotScale(Vector(trs[:3]), Quaternion((trs[6], *trs[3:6])), Vector(trs[7:]))


def set_bones(armature: Any, rest: Joints, joints: Joints) -> None:
    """Pose joints: what each does relative to rest, in the axes that Blender has given its bone."""
    worlds: dict[str, Matrix] = {}
    for bone in armature.data.bones:  # parents first
        parent = worlds[bone.parent.name] if bone.parent else Matrix()
        worlds[bone.name] = parent @ local(rest[bone.name])
        axes = (TO_BLENDER @ worlds[bone.name]).inverted() @ bone.matrix_local
        moved = local(rest[bone.name]).inverted() @ local(joints[bone.name])
        armature.pose.bones[bone.name].matrix_basis = axes.inverted() @ moved @ axes


def posed(path: str, poses: Sequence[Mapping[str, Any]]) -> tuple[list[Any], list[Any]]:
    """The mesh objects of a file that are shown, and their points pose by pose, Y up."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=path)
    meshes = [
        one for one in bpy.context.view_layer.objects if one.type == "MESH" and "_FACEPIPE_POINT" in one.data.attributes
    ]
    armatures = [one for one in bpy.data.objects if one.type == "ARMATURE"]
    points: list[Any] = [[] for _ in meshes]
    for pose in poses:
        for armature in armatures:
            set_bones(armature, poses[0]["joints"], pose["joints"])
        for mesh, found in zip(meshes, points, strict=True):
            keys = mesh.data.shape_keys
            for key in keys.key_blocks[1:] if keys else ():
                key.value = pose["weights"][mesh.name][key.name]
            found.append(world_points(mesh) @ np.array(TO_BLENDER.to_3x3()))
    return meshes, points


found = {}
for i, file in enumerate(json.loads(Path(ARGUMENTS[0]).read_text())):
    meshes, points = posed(file["path"], file["poses"])
    found[f"names {i}"] = np.array([mesh.name for mesh in meshes])
    for j, mesh in enumerate(meshes):
        numbers = np.empty(len(mesh.data.vertices), np.float32)
        mesh.data.attributes["_FACEPIPE_POINT"].data.foreach_get("value", numbers)
        found |= {f"points {i} {j}": numbers, f"positions {i} {j}": np.array(points[j])}
answer(**found)
