"""What the buttons of the panel do."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import bpy

from facepipe.core.errors import FacepipeError, InputError
from facepipe.hosting.deliver import DeliveryReport, deliver, outputs

from .blend_again import blend_again
from .face_objects import FaceObjects, face_of
from .hook import FaceHook


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
            there = ", ".join(one.name for one in outputs(Path(self.directory), self.file_name) if one.exists())
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
            if asked and any(one.exists() for one in outputs(folder, name)):
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
            warnings = blend_again(face, Path(bpy.path.abspath(self.filepath)) if self.filepath else None)
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
        _export_usd(context, face, stage)
        return deliver(stage, folder, name, **options)


def _export_usd(context: Any, face: FaceObjects, path: Path) -> None:
    """Export the objects of a face alone, whatever is selected.

    :raises InputError: a hidden object, which Blender exports not
    :raises FacepipeError: a face that can't be written
    """
    objects = [obj for obj in (face.armature, *face.meshes) if obj is not None]
    for obj in objects:
        if not obj.visible_get():
            raise InputError(obj.name, "is hidden, expected the whole face visible")
    scene, layer = context.scene, context.view_layer
    chosen, active, usd = [obj for obj in layer.objects if obj.select_get()], layer.objects.active, scene.facepipe_usd
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    try:
        for obj in layer.objects:
            obj.select_set(obj in objects)
        scene.facepipe_usd, layer.objects.active = True, face.first
        bpy.ops.wm.usd_export(filepath=str(path), selected_objects_only=True, evaluation_mode="VIEWPORT")
    except RuntimeError as error:  # what Blender's exporter reports
        raise InputError(face.first.name, f"Blender can't export it to USD: {error}") from None
    finally:
        for obj in layer.objects:
            obj.select_set(obj in chosen)
        scene.facepipe_usd, layer.objects.active = usd, active
    if FaceHook.failure is not None:
        raise FaceHook.failure
