"""A head of others that the button gives shapes: OBJ LANDMARKS OUT ANSWER.

The head gets what artists have: a rig, a modifier, groups, a shape key. Landmarks are those of the file, and turned as
Blender turns it. Then the button, undo and redo; the face is exported as OUT.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from session import ARGUMENTS, answer, bpy, np

from facepipe_blender import panel  # isort: skip  (the add-on must be registered)

file, landmarks, out = ARGUMENTS[:3]
bpy.ops.wm.obj_import(filepath=file)
names = [one.name for one in bpy.data.objects]
objects = bpy.data.objects  # until undo: then Blender has others
turned = str(Path(out).with_suffix(".json"))
places = [(x, -z, y) for x, y, z in json.loads(Path(landmarks).read_text())["points"]]
Path(turned).write_text(json.dumps({"points": places}))

head = objects["Head"]
head.modifiers.new("Subdivision", "SUBSURF")
head.vertex_groups.new(name="own").add([1, 2, 3], 0.5, "REPLACE")
head.shape_key_add(name="Basis", from_mix=False)
smile = head.shape_key_add(name="mouthSmile_L", from_mix=False)
smile.data[5].co.x += 0.25
smile.value = 0.5
# an eye hangs at a bone that is away from its rest, and is mirrored
rig = bpy.data.armatures.new("Rig")
armature = bpy.data.objects.new("Rig", rig)
bpy.context.collection.objects.link(armature)
bpy.context.view_layer.objects.active = armature
bpy.ops.object.mode_set(mode="EDIT")
rig.edit_bones.new("eye").tail = (0, 0, 1)
bpy.ops.object.mode_set(mode="OBJECT")
for name in names:
    matrix = objects[name].matrix_world.copy()
    objects[name].parent = armature
    if name == "EyeballLeft":
        objects[name].parent_type, objects[name].parent_bone = "BONE", "eye"
    bpy.context.view_layer.update()
    objects[name].matrix_world = matrix
eye = objects["EyeballRight"]
eye.scale.x = -eye.scale.x
co = np.empty(3 * len(eye.data.vertices), np.float32)
eye.data.vertices.foreach_get("co", co)
eye.data.vertices.foreach_set("co", co * np.tile(np.float32([-1, 1, 1]), len(co) // 3))
eye.data.flip_normals()
armature.pose.bones["eye"].location = (0.0, 3.0, 0.0)


def state() -> dict[str, Any]:
    """What no shape may change; and all keys."""
    bpy.context.view_layer.update()
    found: dict[str, Any] = {}
    for name in names:
        one = bpy.data.objects[name]
        data, keys = one.data, one.data.shape_keys
        points = np.empty(3 * len(data.vertices), np.float32)
        data.vertices.foreach_get("co", points)
        weights = [[(entry.group, entry.weight) for entry in vertex.groups] for vertex in data.vertices[:9]]
        lists = (one.modifiers, one.vertex_groups, data.uv_layers, one.material_slots)
        kept = [[each.name for each in values] for values in lists]
        place = [tuple(row) for row in one.matrix_world]
        found[f"points {name}"] = points
        found[f"rest {name}"] = repr((kept, weights, place, [tuple(face.vertices) for face in data.polygons]))
        found[f"names {name}"] = np.array([key.name for key in keys.key_blocks] if keys else [], dtype=str)
        for key in keys.key_blocks if keys else ():
            offsets = np.empty(3 * len(key.data), np.float32)
            key.data.foreach_get("co", offsets)
            found[f"key {name} {key.name}"] = (offsets - points).reshape(-1, 3)
            found[f"value {name} {key.name}"] = key.value
    return found


def press(*undo: bool, **settings: str) -> str:
    """The button: what it says where it can't."""
    try:
        bpy.ops.facepipe.transfer("EXEC_DEFAULT", *undo, **settings)
        return ""
    except RuntimeError as error:  # Blender raises what an operator reports as an error
        return str(error).strip()


def drawn() -> list[str]:
    """The buttons of the panel."""
    buttons: list[str] = []
    layout = SimpleNamespace(prop=lambda *_: None, label=lambda **_: None, row=lambda: layout)
    layout.column = lambda **_: layout
    layout.operator = lambda name, **_: buttons.append(name) or SimpleNamespace()
    panel.FACEPIPE_PT_face.draw(SimpleNamespace(layout=layout), bpy.context)
    return buttons


for one in objects:
    one.select_set(False)
said = [press(landmarks=turned)]
bpy.context.view_layer.objects.active = objects["Teeth"]
buttons = drawn()
objects["Teeth"].select_set(True)
sys.modules["torch"] = None  # type: ignore[assignment]  # as in Blender's own Python
said.append(press())
del sys.modules["torch"]
said.append(press(landmarks=f"{turned}.none"))
objects["Teeth"].modifiers.new("Mirror", "MIRROR")
said.append(press(landmarks=turned))
objects["Teeth"].modifiers.clear()
bpy.context.view_layer.objects.active = head
states = {"before": state()}
bpy.ops.ed.undo_push(message="before")
bpy.ops.object.mode_set(mode="EDIT")
said.append(press(True, landmarks=turned))
states["after"] = state()
bpy.ops.ed.undo()
states["undone"] = state()
bpy.ops.ed.redo()
states["again"] = state()
bpy.data.objects["Head"].modifiers.clear()  # whose points a stage would have
bpy.data.objects["Rig"].pose.bones["eye"].location = (0.0, 0.0, 0.0)
eye = bpy.data.objects["EyeballRight"]  # an export refuses what is mirrored
for one in bpy.data.objects:
    one.select_set(one == eye)
bpy.context.view_layer.objects.active = eye
bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
bpy.ops.wm.usd_export(filepath=out)
flat = {f"{when} {name}": value for when, found in states.items() for name, value in found.items()}
answer(said=np.array(said), buttons=np.array(buttons), **flat)
