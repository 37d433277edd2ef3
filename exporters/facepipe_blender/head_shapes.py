"""ARKit's shapes on a head of others: the selected objects as a head, and its new shapes as shape keys on them."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.names import identifier
from facepipe.hosting.given_shapes import with_given_shapes
from facepipe.parts import FaceParts, Mesh, Skeleton

from .armature import joint_paths, read_skeleton
from .face_objects import FaceObjects, armature_of
from .read_mesh import read_undeformed
from .write_mesh import add_shapes


class FACEPIPE_OT_transfer(bpy.types.Operator):  # noqa: N801  (Blender's way to name operators)
    """Give the selected head those of ARKit's 52 shapes that it lacks, as shape keys; all else of it stays"""

    bl_idname = "facepipe.transfer"
    bl_label = "Add ARKit Shapes"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    landmarks: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Landmarks",
        subtype="FILE_PATH",
        description="JSON of 68 landmarks of the face, in coordinates of Blender's world; without it they are found",
    )

    def execute(self, context: Any) -> set[str]:
        """Read the head, make the shapes, then add the keys; on an error nothing is added."""
        try:
            active = context.view_layer.objects.active
            if active is not None and active.mode != "OBJECT":
                bpy.ops.object.mode_set(mode="OBJECT")
            head = head_among(context.view_layer.objects)
            name = str((active if active in head.meshes else head.meshes[0]).name)
            landmarks = Path(bpy.path.abspath(self.landmarks)) if self.landmarks else None
            if landmarks is None and importlib.util.find_spec("torch") is None:
                what = "finding it needs torch, which Blender's Python lacks, expected a file of landmarks or: "
                raise InputError(f"face of {name}", f"{what}{sys.executable} -m pip install torch")
            before = _read(head, name, context)
            after, report = with_given_shapes(before, landmarks, _watched)
        except FacepipeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        added: set[str] = set()
        for obj, old, new in zip(head.meshes, before.meshes, after.meshes, strict=True):
            own = {shape.name for shape in old.blendshapes}
            shapes = [shape for shape in new.blendshapes if shape.name not in own]
            if shapes:
                add_shapes(obj, shapes)
            added |= {shape.name for shape in shapes}
        for line in report.as_text(Path(name)).splitlines():
            self.report({"INFO"}, line)
        for line in report.warnings:
            self.report({"WARNING"}, line)
        if not_made := report.to_dict()["not_made"]:
            self.report({"WARNING"}, f"{name}: can't have {', '.join(not_made)}")
        self.report({"INFO"}, f"{name}: {len(added)} shapes added")
        return {"FINISHED"} if added else {"CANCELLED"}


def head_among(objects: Sequence[Any]) -> FaceObjects:
    """The head that the selected ones of some objects are: with all below them, and all that their armature moves.

    :raises InputError: no mesh, meshes of several armatures, or a mesh whose shape keys can't be those of a head
    """
    selected = [obj for obj in objects if obj.select_get()]
    chosen = {one for obj in selected for one in (obj, *obj.children_recursive)}
    armatures = {armature_of(obj) for obj in chosen if obj.type == "MESH"} - {None}
    if len(armatures) > 1:
        names = " and ".join(sorted(one.name for one in armatures)[:2])
        raise InputError("facepipe", f"the selected meshes are moved by {names}, expected those of one head")
    armature = next(iter(armatures), None)
    meshes = [
        obj
        for obj in sorted(objects, key=lambda one: str(one.name))
        if obj.type == "MESH" and obj.visible_get() and len(obj.data.polygons)
        if obj in chosen or (armature is not None and armature_of(obj) == armature)
    ]
    if not meshes:
        raise InputError("facepipe", "no mesh with faces is selected, expected a head")
    owners: dict[Any, Any] = {}
    for obj in meshes:
        keys, other = obj.data.shape_keys, owners.setdefault(obj.data, obj)
        if other != obj:
            raise InputError(obj.name, f"has the mesh of {other.name}, expected its own (Make Single User)")
        if obj.data.library is not None:
            raise InputError(obj.name, "its mesh is linked from another file, expected it local")
        if keys is not None and not keys.use_relative:
            raise InputError(obj.name, "absolute shape keys, expected relative ones")
        if any(one.type == "MIRROR" and one.show_viewport for one in obj.modifiers):
            raise InputError(obj.name, "a Mirror modifier makes half of it, expected it applied")
    return FaceObjects(armature=armature, meshes=tuple(meshes))


def _read(head: FaceObjects, name: str, context: Any) -> FaceParts:
    """The head at rest, without modifiers: its points are those that shape keys have."""
    armature = head.armature
    with _at_rest(armature, context):
        skeleton, joints = Skeleton(), dict[str, int]()
        if armature is not None:
            skeleton = replace(read_skeleton(armature), transform=np.array(armature.matrix_world, np.float64))
            place = {joint: number for number, joint in enumerate(skeleton.joints)}
            joints = {bone: place[path] for bone, path in joint_paths(armature).items()}
        return FaceParts(
            name=identifier(name, "Head"),
            meters_per_unit=context.scene.unit_settings.scale_length,
            up_axis="Z",
            meshes=tuple(_mesh(obj, joints, skeleton) for obj in head.meshes),
            skeleton=skeleton,
        )


def _mesh(obj: Any, joints: dict[str, int], skeleton: Skeleton) -> Mesh:
    """The mesh in the space of its object, which is that of its shape keys; the object's place is its transform."""
    mesh, to_world = read_undeformed(obj, joints), np.array(obj.matrix_world, np.float64)
    if mesh.skin is not None:
        bind = np.linalg.inv(skeleton.transform) @ to_world
        mesh = replace(mesh, skin=replace(mesh.skin, geom_bind_transform=bind))
    if np.linalg.det(to_world[:3, :3]) < 0:  # Blender shows the faces of a mirrored object from their other side
        counts, indices = mesh.face_vertex_counts[::-1], mesh.face_vertex_indices[::-1]
        mesh = replace(mesh, face_vertex_counts=counts, face_vertex_indices=indices)
    return replace(mesh, transform=to_world)


@contextlib.contextmanager
def _at_rest(armature: Any, context: Any) -> Iterator[None]:
    """Objects that hang at bones are where these rest, as the points that bones move are."""
    if armature is None:
        context.view_layer.update()
        yield
        return
    before, armature.data.pose_position = armature.data.pose_position, "REST"
    context.view_layer.update()
    try:
        yield
    finally:
        armature.data.pose_position = before
        context.view_layer.update()


@contextlib.contextmanager
def _watched(label: str, steps: int) -> Iterator[Any]:
    """Progress that Blender shows at the mouse."""
    manager, done = bpy.context.window_manager, iter(range(1, steps + 1))
    manager.progress_begin(0, steps)
    try:
        yield SimpleNamespace(update=lambda: manager.progress_update(next(done, steps)))
    finally:
        manager.progress_end()
