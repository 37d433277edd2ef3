"""Blender's USD export and import, with faces; messages stand where the user looks, in status bar and Info editor."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import bpy

from facepipe.core.errors import FacepipeError

from .export_stage import export_faces
from .import_stage import import_faces, objects_by_name

_waiting: list[tuple[str, str]] = []


def _show_messages(lines: Iterable[str], *, error: bool = False) -> None:
    """Show lines. USD hooks may run beside Blender's main thread, so that this waits for it where there is a window."""
    for line in lines:
        print(f"facepipe: {line}", file=sys.stderr)
        _waiting.append(("ERROR" if error else "WARNING", line))
    if bpy.app.background:
        _waiting.clear()
    elif not bpy.app.timers.is_registered(_show_waiting):
        bpy.app.timers.register(_show_waiting)


def _show_waiting() -> None:
    while _waiting:
        kind, line = _waiting.pop(0)
        bpy.ops.facepipe.message("INVOKE_DEFAULT", kind=kind, line=line)


class FACEPIPE_OT_message(bpy.types.Operator):  # noqa: N801  (Blender's way to name operators)
    """Show a message of facepipe"""

    bl_idname = "facepipe.message"
    bl_label = "facepipe"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    kind: bpy.props.StringProperty()  # type: ignore[valid-type]
    line: bpy.props.StringProperty()  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Report the line; an error is shown as a popup too."""
        self.report({self.kind}, self.line)
        return {"FINISHED"}


class FaceHook(bpy.types.USDHook):
    """Faces of facepipe in USD files. After an error the file is as Blender writes or reads it without facepipe."""

    bl_idname = "facepipe"
    bl_label = "facepipe"
    bl_description = "Exports armatures and meshes with shape keys as faces, and imports faces whole"

    failure: FacepipeError | None = None  # of the last export, for operators that export
    warnings: tuple[str, ...] = ()

    @staticmethod
    def on_export(export_context: Any) -> bool:
        """Turn Blender's prims of faces into faces."""
        scene = export_context.get_depsgraph().scene
        FaceHook.failure, FaceHook.warnings = None, ()
        if not scene.facepipe_usd:
            return False
        try:
            active = scene.view_layers[0].objects.active
            FaceHook.warnings = export_faces(export_context.get_stage(), scene.objects, active)
            _show_messages(FaceHook.warnings)
        except FacepipeError as error:
            FaceHook.failure = error
            _show_messages([str(error)], error=True)
            return False
        return True

    @staticmethod
    def on_import(import_context: Any) -> bool:
        """Restore what Blender drops of faces."""
        try:
            stage = import_context.get_stage()
            known = hasattr(import_context, "get_prim_map")  # from Blender 4.4 on
            _show_messages(import_faces(stage, import_context.get_prim_map() if known else objects_by_name(stage)))
        except FacepipeError as error:
            _show_messages([str(error)], error=True)
            return False
        return True
