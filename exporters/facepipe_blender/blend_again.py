"""A blended face made again from its recipe, on the objects that it was imported as."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from facepipe.core.errors import InputError, TopologyError
from facepipe.hosting.live_blend import reblended

from .face_objects import FaceObjects
from .groups import write_skin
from .read_armature import bone_matrices, joint_paths
from .record import MESH, keep, kept_in
from .write_armature import move_bones
from .write_mesh import write_mesh


def blend_again(face: FaceObjects, file: Path | None) -> tuple[str, ...]:
    """Blend again and write points, shapes, regions and bones; on an error nothing is written.

    :param file: what `facepipe blend` wrote; None for the file that the face was imported from
    :returns: one line for each source that has changed since
    :raises InputError: a face that was not imported, no recipe of a blend, or a source that is gone
    :raises TopologyError: other points or joints than in Blender
    """
    if face.record is None:
        raise InputError(face.first.name, "was not imported from a face of facepipe, expected one that blend wrote")
    kept = kept_in(face.record)
    path = file or Path(kept.file)
    found = reblended(path)
    objects = {str(obj.get(MESH, "")): obj for obj in face.meshes}
    meshes = {mesh.name: mesh for mesh in found.parts.meshes}
    if meshes.keys() != objects.keys():
        raise TopologyError(path, f"meshes {', '.join(meshes)}, expected {', '.join(objects)} as in Blender")
    for name, mesh in meshes.items():
        there = len(objects[name].data.vertices)
        if there != len(mesh.points):
            raise TopologyError(f"{path} -> {name}", f"{len(mesh.points)} points, expected {there} as in Blender")
    old, new = kept.parts.skeleton, found.parts.skeleton
    if old.joints != new.joints or {*bone_matrices(face.armature)} != {*old.joints}:
        raise TopologyError(f"{path} -> {new.name}", "other joints than in Blender, expected the same")
    bones = {path: name for name, path in joint_paths(face.armature).items()}
    for name, mesh in meshes.items():
        write_mesh(objects[name], mesh)
        if mesh.skin is not None:
            write_skin(objects[name], mesh.skin, [bones[joint] for joint in new.joints])
        if mesh.normals is not None and len(mesh.normals) == len(mesh.points):
            objects[name].data.normals_split_custom_set_from_vertices(mesh.normals.tolist())
    if face.armature is not None:
        move_bones(face.armature, old, new)
    again = replace(kept, parts=found.parts, bones=bone_matrices(face.armature), file=path.as_posix())
    keep(again, face.record)
    return found.warnings
