"""Blender's USD export and import, with faces."""

from __future__ import annotations

from typing import Any

import bpy

from facepipe.core.errors import FacepipeError

from .export_stage import export_faces
from .import_stage import import_faces, objects_by_name
from .messages import tell


class FaceHook(bpy.types.USDHook):
    """Faces of facepipe in USD files. After an error the file is as Blender alone writes or reads it."""

    bl_idname = "facepipe"
    bl_label = "facepipe"
    bl_description = "Exports armatures and meshes with shape keys as faces, and imports faces whole"

    failure: FacepipeError | None = None  # of the last export, for operators that export
    warnings: tuple[str, ...] = ()

    @staticmethod
    def on_export(export_context: Any) -> bool:
        """Turn what Blender wrote of faces into faces."""
        scene = export_context.get_depsgraph().scene
        FaceHook.failure, FaceHook.warnings = None, ()
        if not scene.facepipe_usd:
            return False
        try:
            active = scene.view_layers[0].objects.active
            FaceHook.warnings = export_faces(export_context.get_stage(), scene.objects, active)
            tell(FaceHook.warnings)
        except FacepipeError as error:
            FaceHook.failure = error
            tell([str(error)], error=True)
            return False
        return True

    @staticmethod
    def on_import(import_context: Any) -> bool:
        """Bring back what Blender drops of faces."""
        try:
            stage = import_context.get_stage()
            known = hasattr(import_context, "get_prim_map")  # from Blender 4.4 on
            tell(import_faces(stage, import_context.get_prim_map() if known else objects_by_name(stage)))
        except FacepipeError as error:
            tell([str(error)], error=True)
            return False
        return True
