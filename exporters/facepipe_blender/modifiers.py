"""Meshes with their modifiers applied, shape keys and all: what Blender itself does for meshes without keys alone."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np


@contextlib.contextmanager
def with_modifiers(obj: Any, warnings: list[str]) -> Iterator[Any]:
    """The mesh object with its modifiers applied to each shape key: all but Armature that the viewport shows.

    It is a copy, removed after the block; the object itself where there are no modifiers, or they can't be applied.

    :param warnings: gets a line for what is not applied
    """
    modifiers = [
        modifier
        for modifier in obj.modifiers
        if modifier.type != "ARMATURE" and (modifier.show_viewport or modifier.show_render)
    ]
    hidden = [modifier.name for modifier in modifiers if not modifier.show_viewport]
    if hidden:
        warnings.append(f"{obj.name}: modifiers {_listed(hidden)} are not applied, the viewport doesn't show them")
    if len(hidden) == len(modifiers):
        yield obj
        return
    with contextlib.ExitStack() as after:
        # Blender's own USD export may run beside the main thread, where no objects can be made
        made = _applied(obj, after) if threading.current_thread() is threading.main_thread() else None
        if made is None:
            names = _listed([modifier.name for modifier in modifiers if modifier.show_viewport])
            warnings.append(f"{obj.name}: modifiers {names} are not applied, {_reason()}")
        yield made or obj


def _reason() -> str:
    if threading.current_thread() is threading.main_thread():
        return "they make other points of some shape key"
    return "Blender exports in the background (Export GLB + ONNX applies them)"


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:3])} ({len(names)} in all)"


def _applied(obj: Any, after: contextlib.ExitStack) -> Any:
    """A copy of the object whose mesh and keys are as modified; None where a key has other points then."""
    work = _copy(obj, obj.data.copy(), after)
    for modifier in [one for one in work.modifiers if one.type == "ARMATURE" or not one.show_viewport]:
        work.modifiers.remove(modifier)
    keys = work.data.shape_keys
    blocks = [] if keys is None else [one for one in keys.key_blocks if one != keys.reference_key]
    if keys is not None:
        keys.use_relative = True
        keys.animation_data_clear()
    for block in blocks:
        block.slider_min, block.slider_max, block.value, block.mute = 0.0, 1.0, 0.0, False
    bpy.context.scene.collection.objects.link(work)
    mesh = bpy.data.meshes.new_from_object(
        _evaluated(work), preserve_all_data_layers=True, depsgraph=bpy.context.evaluated_depsgraph_get()
    )
    made = _copy(obj, mesh, after)
    made.modifiers.clear()
    if mesh.shape_keys is not None:
        made.shape_key_clear()
    names = ["Basis"] if keys is None else [keys.reference_key.name]
    if blocks:
        made.shape_key_add(name=names[0], from_mix=False)
    for block in blocks:
        block.value = 1.0
        data = _evaluated(work).data
        points = np.empty(3 * len(data.vertices), dtype=np.float32)
        data.vertices.foreach_get("co", points)
        block.value = 0.0
        # a modifier may make other points of each key (decimate, weld): these are no offsets
        if len(points) != 3 * len(mesh.vertices):
            return None
        added = made.shape_key_add(name=block.name, from_mix=False)
        added.data.foreach_set("co", points)
    return made


def _copy(obj: Any, data: Any, after: contextlib.ExitStack) -> Any:
    """A copy of an object with other data, both gone in the end."""
    made = obj.copy()
    made.data = data
    made.animation_data_clear()
    after.callback(bpy.data.meshes.remove, data)
    after.callback(bpy.data.objects.remove, made)
    return made


def _evaluated(obj: Any) -> Any:
    bpy.context.view_layer.update()
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
