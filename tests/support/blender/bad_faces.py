"""Faces that can't be written: FOLDER. Each file is then as Blender alone writes it."""

from pathlib import Path
from typing import Any

from session import ARGUMENTS, bpy

from facepipe_blender.hook import FaceHook  # isort: skip  (the add-on must be registered)

folder = Path(ARGUMENTS[0])
on_export, answers = FaceHook.on_export, []


def answered(context: Any) -> bool:
    """Export, and note what Blender is told."""
    answers.append(on_export(context))
    return answers[-1]


FaceHook.on_export = staticmethod(answered)
bpy.ops.mesh.primitive_grid_add(x_subdivisions=4, y_subdivisions=4)
head = bpy.context.active_object
head.name = "Head"
head.shape_key_add(name="Basis")
head.shape_key_add(name="smile").data[2].co.z += 0.1


def written(name: str, **settings: bool) -> str:
    """The file that an export writes."""
    path = folder / name
    bpy.ops.wm.usd_export(filepath=str(path), **settings)
    text = path.read_text()
    path.unlink()
    return text


def without_hook(name: str) -> str:
    """The same without faces."""
    bpy.context.scene.facepipe_usd = False
    text = written(name)
    bpy.context.scene.facepipe_usd = True
    return text


def lines(text: str) -> list[str]:
    """Its lines in some order: Blender has none for prims."""
    return sorted(line for line in text.splitlines() if line.strip())


assert "FacepipeFaceAPI" in written("good.usda")
head.scale = (-1, 1, 1)
assert lines(written("mirrored.usda")) == lines(without_hook("mirrored.usda"))

armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
bpy.context.collection.objects.link(armature)
bpy.context.view_layer.objects.active = armature
bpy.ops.object.mode_set(mode="EDIT")
armature.data.edit_bones.new("root").tail = (0, 0, 1)
bpy.ops.object.mode_set(mode="OBJECT")
head.scale = (1, 1, 1)
head.modifiers.new("Armature", "ARMATURE").object = armature
armature.scale = (1, 2, 1)
assert lines(written("stretched.usda")) == lines(without_hook("stretched.usda"))
assert answers == [True, False, False, False, False]
