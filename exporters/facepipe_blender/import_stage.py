"""Faces of a stage that Blender has imported: restores what Blender dropped."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.hosting.host_face import Face, faces_on, neural_rig_of

from .armature import bone_matrices
from .face_objects import MESH, RECORD, Kept, keep, record_of
from .write_mesh import write_mesh


def import_faces(stage: Usd.Stage, prim_map: Mapping[Any, Sequence[Any]]) -> tuple[str, ...]:
    """Complete the objects of all faces on a stage.

    :param prim_map: prim path -> what Blender made of it
    :returns: one line for each thing that was left out
    :raises SchemaError, TopologyError: a face that doesn't follow the stage convention
    """
    made = {str(path): list(ids) for path, ids in prim_map.items()}
    warnings: list[str] = []
    for face in faces_on(stage):
        parts = face.with_identity().parts()  # read whole before anything changes
        armature, objects = _objects(face, made)
        if not objects:
            continue
        missing = [mesh.name for mesh in parts.meshes if mesh.name not in objects]
        if missing:
            warnings.append(f"{face.where}: meshes {', '.join(missing[:3])} were not imported")
        for mesh in parts.meshes:
            obj = objects.get(mesh.name)
            if obj is not None and len(obj.data.vertices) == len(mesh.points):
                write_mesh(obj, mesh)
            elif obj is not None:
                what = f"{len(obj.data.vertices)} points in Blender, {len(mesh.points)} in the file"
                warnings.append(f"{obj.name}: {what}: shapes and regions left out")
        file = Path(stage.GetRootLayer().realPath).as_posix() if stage.GetRootLayer().realPath else ""
        bpy.context.view_layer.update()
        names = [mesh.name for mesh in parts.meshes if mesh.name in objects]
        first = armature or min(objects.values(), key=lambda obj: str(obj.name))
        back = np.linalg.inv(np.array(first.matrix_world, dtype=np.float64))
        text = bpy.data.texts.new(f"facepipe {parts.name}")
        keep(
            Kept(
                parts=parts,
                bones=bone_matrices(armature),
                places={name: back @ np.array(objects[name].matrix_world, np.float64) for name in names},
                file=file,
                neural_rig=neural_rig_of(face),
            ),
            text,
        )
        for obj in (armature, *objects.values()):
            if obj is not None:
                obj[RECORD] = text
        for name, obj in objects.items():
            obj[MESH] = name
    return tuple(warnings)


def objects_by_name(stage: Usd.Stage) -> dict[str, list[Any]]:
    """Prim path -> Blender's object for it, found by name: the newest one of that name that belongs to no face yet."""
    free: dict[str, list[Any]] = {}
    for obj in sorted(bpy.data.objects, key=lambda one: str(one.name), reverse=True):
        if record_of(obj) is None and obj.type in ("ARMATURE", "MESH"):
            free.setdefault(re.sub(r"\.\d{3,}$", "", str(obj.name)), []).append(obj)
    kinds = (("ARMATURE", UsdSkel.Skeleton), ("MESH", UsdGeom.Mesh))
    made: dict[str, list[Any]] = {}
    for prim in stage.Traverse():
        named = free.get(str(prim.GetName()), [])
        candidates = [obj for obj in named for kind, schema in kinds if obj.type == kind and prim.IsA(schema)]
        if candidates:
            named.remove(candidates[0])
            made[str(prim.GetPath())] = candidates[:1]
    return made


def _objects(face: Face, made: Mapping[str, Sequence[Any]]) -> tuple[Any, dict[str, Any]]:
    """The armature and, by mesh, the objects that Blender made of a face."""
    armature = None
    for path, ids in made.items():
        prim = face.stage.GetPrimAtPath(path)
        if prim and prim.IsA(UsdSkel.Skeleton) and path.startswith(f"{face.prim.GetPath()}/"):
            armature = _object(ids, "ARMATURE")
    found = {mesh.name: _object(made.get(str(face.mesh_prim(mesh.name).GetPath()), ()), "MESH") for mesh in face.meshes}
    return armature, {name: obj for name, obj in found.items() if obj is not None}


def _object(ids: Sequence[Any], kind: str) -> Any:
    """The object of a kind among what Blender made of a prim, or that holds it."""
    for made in ids:
        if getattr(made, "type", None) == kind:
            return made
    for made in ids:
        for obj in bpy.data.objects:
            if obj.data is not None and obj.data == made and obj.type == kind:
                return obj
    return None
