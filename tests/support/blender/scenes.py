"""Scenes as artists leave them, each exported on its own: FOLDER ANSWER. What Blender shows is answered."""

from pathlib import Path
from typing import Any

from session import ARGUMENTS, answer, bpy, np, world_points

folder = Path(ARGUMENTS[0])
shown: dict[str, np.ndarray] = {}


def head(name: str, x: float = 0.0) -> Any:
    """A mesh with a shape, a region and a UV map."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=6, y_subdivisions=5, location=(x, 0, 0))
    made = bpy.context.active_object
    made.name = name
    made.shape_key_add(name="Basis")
    made.shape_key_add(name="smile", from_mix=False).data[3].co.z += 0.25
    made.data.shape_keys.key_blocks["smile"].value = 0.0
    made.vertex_groups.new(name="region:mouth").add(range(len(made.data.vertices)), 1.0, "REPLACE")
    return made


def rig(name: str, mesh: Any, x: float = 0.0) -> Any:
    """An armature that moves a mesh."""
    made = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.collection.objects.link(made)
    bpy.context.view_layer.objects.active = made
    bpy.ops.object.mode_set(mode="EDIT")
    made.data.edit_bones.new("root").tail = (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    made.location.x = x
    mesh.modifiers.new("Armature", "ARMATURE").object = made
    mesh.vertex_groups.new(name="root").add(range(len(mesh.data.vertices)), 1.0, "REPLACE")
    return made


def export(name: str) -> None:
    """Write the scene as NAME.usda, note what Blender shows, and begin anew."""
    bpy.ops.wm.usd_export(filepath=str(folder / f"{name}.usda"))
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for obj in bpy.data.objects:
        if obj.type == "MESH":
            shown[f"{name} {obj.name}"] = world_points(obj)
    bpy.ops.wm.read_factory_settings(use_empty=True)


rig("RigA", head("HeadA"))
rig("RigB", head("HeadB", 5.0), 5.0)
head("Loose", 10.0)
bpy.context.view_layer.objects.active = bpy.data.objects["HeadB"]
export("several")

edited = head("Head")
bpy.ops.object.mode_set(mode="EDIT")
bpy.ops.mesh.select_all(action="SELECT")
bpy.ops.mesh.subdivide()
export("mesh_in_edit_mode")

rig("Rig", head("Head"))
bpy.context.view_layer.objects.active = bpy.data.objects["Rig"]
bpy.ops.object.mode_set(mode="EDIT")
bpy.data.objects["Rig"].data.edit_bones.new("extra").tail = (0, 0, 2)
export("bones_in_edit_mode")

related = head("Head")
related.rotation_euler = (0, 0, 0.3)
related.scale = (1, 2, 3)
wide = related.shape_key_add(name="wide", from_mix=False)
wide.data[7].co.z += 0.5
keys = related.data.shape_keys.key_blocks
wide.relative_key, wide.value, keys["smile"].value, keys["smile"].mute = keys["smile"], 0.5, 1.0, True
export("relative_keys")

part = head("Eye")
armature = rig("Rig", head("Head"))
part.parent, part.parent_type, part.parent_bone = armature, "BONE", "root"
export("part_on_a_bone")

part = head("Eye")
armature = rig("Rig", head("Head"))
part.modifiers.new("Armature", "ARMATURE").object = armature
part.hide_render = True
export("hidden_mesh")
armature = rig("Rig", head("Head"))
armature.hide_render = True
export("hidden_armature")
mirrored = head("Head")
mirrored.vertex_groups["region:mouth"].remove([0, 1])
mirrored.modifiers.new("Hidden", "SUBSURF").show_viewport = False
export("hidden_modifier")
modified = head("Head")
mirror = modified.modifiers.new("Mirror", "MIRROR")
mirror.use_axis, mirror.use_mirror_merge = (False, False, True), False
modified.modifiers.new("Smooth", "SUBSURF").levels = 1
modified.modifiers.new("Thick", "SOLIDIFY").thickness = 0.1
modified.location.z = 1
rig("Rig", modified)
modified.data.shape_keys.key_blocks["smile"].value = 1.0
export("modifiers")
welded = head("Head")
welded.modifiers.new("Weld", "WELD").merge_threshold = 0.01
welded.data.shape_keys.key_blocks["smile"].data[3].co = welded.data.shape_keys.key_blocks["smile"].data[4].co
export("other_points")
head("Head").scale.x = 0
export("flat")
bpy.ops.mesh.primitive_cube_add()
export("no_shapes")
answer(**shown)
