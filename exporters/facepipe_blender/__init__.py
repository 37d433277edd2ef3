"""facepipe in Blender: faces in USD exports and imports, a one-click export, blends made again.

Blender loads this package as an extension; nothing here needs Blender before `register` is called.
"""

from __future__ import annotations


def register() -> None:
    """Called by Blender when the add-on is enabled."""
    import bpy

    if hasattr(bpy.utils, "expose_bundled_modules"):  # from Blender 4.4 on; before, they are on Python's path
        bpy.utils.expose_bundled_modules()  # Blender's own USD, before anything imports pxr
    from .panel import register_all

    register_all()


def unregister() -> None:
    """Called by Blender when the add-on is disabled."""
    from .panel import unregister_all

    unregister_all()
