"""The panel in the sidebar of the 3D view, what its buttons do, and all that the add-on registers."""

from __future__ import annotations

import atexit
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy

from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.hosting.deliver import DeliveryReport, deliver, outputs
from facepipe.hosting.host_face import register_schemas
from facepipe.hosting.live_blend import reblended

from .armature import bone_matrices, joint_paths, move_bones
from .face_objects import MESH, FaceObjects, face_of, keep, kept_in
from .head_shapes import FACEPIPE_OT_transfer
from .hook import FaceHook, FACEPIPE_OT_message
from .write_mesh import read_key_name, write_mesh, write_skin


class FACEPIPE_OT_export(bpy.types.Operator):  # noqa: N801  (Blender's way to name operators)
    """Write GLB, ONNX and a report of the face of the active object"""

    bl_idname = "facepipe.export"
    bl_label = "Export GLB + ONNX"

    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH")  # type: ignore[valid-type]
    file_name: bpy.props.StringProperty(name="Name", description="Name of the files; the face's by default")  # type: ignore[valid-type]
    sliders: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Sliders", description="The ONNX graph takes the face's sliders in place of bones and shapes"
    )

    overwrite: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Overwrite", description="Put the files in place of others of their names", options={"SKIP_SAVE"}
    )
    ask: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Ask for the folder; then, if need be, whether to overwrite what is there."""
        if self.ask:
            self.overwrite = True
            there = ", ".join(
                output.name for output in outputs(Path(self.directory), self.file_name) if output.exists()
            )
            return set(context.window_manager.invoke_confirm(self, event, title="Overwrite?", message=there))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Export the face to USD in a temporary folder, and from there."""
        try:
            face = face_of(context.active_object, context.scene.objects)
            folder = Path(bpy.path.abspath(self.directory)) if self.directory else Path()
            name = self.file_name or face.name
            asked = self.options.is_invoke and not self.overwrite
            if asked and any(output.exists() for output in outputs(folder, name)):
                settings = {"directory": str(folder), "file_name": name, "sliders": self.sliders, "ask": True}
                bpy.ops.facepipe.export("INVOKE_DEFAULT", **settings)
                return {"CANCELLED"}
            report = _deliver(context, face, folder, name, sliders=self.sliders, overwrite=self.overwrite)
        except FacepipeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for line in [*FaceHook.warnings, *report.warnings]:
            self.report({"WARNING"}, line)
        for one in report.findings:
            self.report({one.severity.upper()}, f"{one.where}: {one.message}")
        for line in report.facts:
            self.report({"INFO"}, f"not in the files: {line}")
        found = f"{report.errors} error(s), {len(report.findings) - report.errors} other finding(s)"
        self.report({"INFO"}, f"{', '.join(one.name for one in report.files)}: {found}")
        return {"FINISHED"}


class FACEPIPE_OT_blend(bpy.types.Operator):  # noqa: N801
    """Blend the face of the active object again from the recipe of its file, and update meshes, shapes and bones"""

    bl_idname = "facepipe.blend"
    bl_label = "Apply Blend Recipe"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="File", subtype="FILE_PATH", description="What facepipe blend wrote; the imported file by default"
    )

    def execute(self, context: Any) -> set[str]:
        """Blend, then write on the objects."""
        try:
            face = face_of(context.active_object, context.scene.objects)
            file = Path(bpy.path.abspath(self.filepath)) if self.filepath else None
            # blend again and write points, shapes, regions and bones; on an error nothing is written
            if face.record is None:
                raise InputError(
                    face.first.name, "was not imported from a face of facepipe, expected one that blend wrote"
                )
            kept = kept_in(face.record)
            path = file or Path(kept.file)
            blended, warnings = reblended(path)
            objects = {str(obj.get(MESH, "")): obj for obj in face.meshes}
            meshes = {mesh.name: mesh for mesh in blended.meshes}
            # all is checked before the first point moves: half a face of the new blend would be one of neither
            if meshes.keys() != objects.keys():
                raise TopologyError(path, f"meshes {', '.join(meshes)}, expected {', '.join(objects)} as in Blender")
            for name, mesh in meshes.items():
                there = len(objects[name].data.vertices)
                if there != len(mesh.points):
                    raise TopologyError(
                        f"{path} -> {name}", f"{len(mesh.points)} points, expected {there} as in Blender"
                    )
            old, new = kept.parts.skeleton, blended.skeleton
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
            again = replace(kept, parts=blended, bones=bone_matrices(face.armature), file=path.as_posix())
            keep(again, face.record)
        except FacepipeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for line in warnings:
            self.report({"INFO"}, line)
        self.report({"INFO"}, f"{face.name}: blended again")
        return {"FINISHED"}


def _deliver(context: Any, face: FaceObjects, folder: Path, name: str, **options: bool) -> DeliveryReport:
    if not folder.is_dir():
        raise InputError(folder, "the folder does not exist")
    with tempfile.TemporaryDirectory() as temporary:
        stage = Path(temporary) / "face.usdc"
        # export the objects of a face alone, whatever is selected
        objects = [obj for obj in (face.armature, *face.meshes) if obj is not None]
        for obj in objects:
            if not obj.visible_get():
                raise InputError(obj.name, "is hidden, expected the whole face visible")
        scene, layer = context.scene, context.view_layer
        chosen, active, usd = (
            [obj for obj in layer.objects if obj.select_get()],
            layer.objects.active,
            scene.facepipe_usd,
        )
        if active is not None and active.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        try:
            for obj in layer.objects:
                obj.select_set(obj in objects)
            scene.facepipe_usd, layer.objects.active = True, face.first
            bpy.ops.wm.usd_export(filepath=str(stage), selected_objects_only=True, evaluation_mode="VIEWPORT")
        except RuntimeError as error:  # what Blender's exporter reports
            raise InputError(face.first.name, f"Blender can't export it to USD: {error}") from None
        finally:
            for obj in layer.objects:
                obj.select_set(obj in chosen)
            scene.facepipe_usd, layer.objects.active = usd, active
        if FaceHook.failure is not None:
            raise FaceHook.failure
        return deliver(stage, folder, name, **options)


class FACEPIPE_PT_face(bpy.types.Panel):  # noqa: N801  (Blender's way to name panels)
    """The face of the active object, and what can be done with it"""

    bl_idname = "FACEPIPE_PT_face"
    bl_label = "Face"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "facepipe"

    def draw(self, context: Any) -> None:
        """What the face is, or why there is none; the buttons."""
        scene = context.scene
        self.layout.prop(scene, "facepipe_usd")
        _draw_face(self.layout, context)
        column = self.layout.column(align=True)
        column.prop(scene, "facepipe_landmarks")
        column.operator(FACEPIPE_OT_transfer.bl_idname, icon="SHAPEKEY_DATA").landmarks = scene.facepipe_landmarks


def _draw_face(layout: Any, context: Any) -> None:
    try:
        face = face_of(context.active_object, context.scene.objects)
    except FacepipeError as error:
        for line in (error.where, *error.what.split(", ")):
            layout.label(text=line)
        return
    of_meshes = [mesh.data.shape_keys for mesh in face.meshes if mesh.data.shape_keys]
    names = [read_key_name(key.name) for one in of_meshes for key in one.key_blocks if key != one.reference_key]
    shapes = {name.shape for name in names if name.weight is None}
    bones = len(face.armature.data.bones) if face.armature else 0
    column = layout.column(align=True)
    column.label(text=face.first.name, icon="USER")
    column.label(text=f"{len(face.meshes)} meshes, {len(shapes)} shapes, {bones} bones")
    column.label(text="imported: nothing of it is lost" if face.record else "made in Blender")
    layout.operator(FACEPIPE_OT_export.bl_idname, icon="EXPORT")
    row = layout.row()
    row.enabled = face.record is not None
    row.operator(FACEPIPE_OT_blend.bl_idname, icon="FILE_REFRESH")


CLASSES = (FACEPIPE_OT_message, FACEPIPE_OT_export, FACEPIPE_OT_blend, FACEPIPE_OT_transfer, FACEPIPE_PT_face, FaceHook)


def register_all() -> None:
    """Register classes and the scene's property."""
    register_schemas()  # for Blender's USD, where it has opened no stage yet
    bpy.types.Scene.facepipe_usd = bpy.props.BoolProperty(
        name="Faces in USD files",
        description="Armatures and meshes with shape keys are exported to USD as faces of facepipe",
        default=True,
    )
    bpy.types.Scene.facepipe_landmarks = bpy.props.StringProperty(
        name="Landmarks",
        subtype="FILE_PATH",
        description="JSON of 68 landmarks of the face to add shapes to; without it they are found",
    )
    for one in CLASSES:
        bpy.utils.register_class(one)
    atexit.register(unregister_all)  # Blender 4.5 as a module never ends with a hook in it


def unregister_all() -> None:
    """Take back what `register_all` added."""
    atexit.unregister(unregister_all)
    for one in reversed(CLASSES):
        bpy.utils.unregister_class(one)
    del bpy.types.Scene.facepipe_usd, bpy.types.Scene.facepipe_landmarks
