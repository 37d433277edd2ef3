"""What the add-on adds to Blender."""

from __future__ import annotations

import atexit

import bpy

from facepipe.hosting.host_face import register_schemas

from .hook import FaceHook, FACEPIPE_OT_message
from .panel import FACEPIPE_OT_blend, FACEPIPE_OT_export, FACEPIPE_PT_face

CLASSES = (FACEPIPE_OT_message, FACEPIPE_OT_export, FACEPIPE_OT_blend, FACEPIPE_PT_face, FaceHook)


def register_all() -> None:
    """Register classes and the scene's property."""
    register_schemas()  # for Blender's USD, where it has opened no stage yet
    bpy.types.Scene.facepipe_usd = bpy.props.BoolProperty(
        name="Faces in USD files",
        description="Armatures and meshes with shape keys are exported to USD as faces of facepipe",
        default=True,
    )
    for one in CLASSES:
        bpy.utils.register_class(one)
    atexit.register(unregister_all)  # Blender 4.5 as a module never ends with a hook in it


def unregister_all() -> None:
    """Take back what `register_all` added."""
    atexit.unregister(unregister_all)
    for one in reversed(CLASSES):
        bpy.utils.unregister_class(one)
    del bpy.types.Scene.facepipe_usd
