"""The panel in the sidebar of the 3D view."""

from __future__ import annotations

from typing import Any

import bpy

from facepipe.core.errors import FacepipeError

from .face_objects import face_of
from .inbetween_keys import read_key_name
from .operators import FACEPIPE_OT_blend, FACEPIPE_OT_export


class FACEPIPE_PT_face(bpy.types.Panel):  # noqa: N801  (Blender's way to name panels)
    """The face of the active object, and what can be done with it"""

    bl_idname = "FACEPIPE_PT_face"
    bl_label = "Face"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "facepipe"

    def draw(self, context: Any) -> None:
        """Tell what the face is, or why there is none; the buttons."""
        layout = self.layout
        layout.prop(context.scene, "facepipe_usd")
        try:
            face = face_of(context.active_object, context.scene.objects)
        except FacepipeError as error:
            for line in (error.where, *error.what.split(", ")):
                layout.label(text=line)
            return
        names = [read_key_name(key.name) for obj in face.meshes if obj.data.shape_keys for key in _keys(obj)]
        shapes = {one.shape for one in names if one.weight is None}
        bones = len(face.armature.data.bones) if face.armature else 0
        column = layout.column(align=True)
        column.label(text=face.first.name, icon="USER")
        column.label(text=f"{len(face.meshes)} meshes, {len(shapes)} shapes, {bones} bones")
        column.label(text="imported: nothing of it is lost" if face.record else "made in Blender")
        layout.operator(FACEPIPE_OT_export.bl_idname, icon="EXPORT")
        row = layout.row()
        row.enabled = face.record is not None
        row.operator(FACEPIPE_OT_blend.bl_idname, icon="FILE_REFRESH")


def _keys(obj: Any) -> list[Any]:
    keys = obj.data.shape_keys
    return [key for key in keys.key_blocks if key != keys.reference_key]
