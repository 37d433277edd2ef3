"""Pictures of a head of others that the button gave shapes: OBJ LANDMARKS SETTINGS FOLDER.

One for each of the settings. Landmarks are those of the file. Materials are plain, by the names of parts; hidden
are cards of lashes, and what has no shapes.
"""

import json
from pathlib import Path

from session import ARGUMENTS, Vector, bpy, np

file, landmarks, settings, folder = ARGUMENTS
LOOKS = {"eye": (0.7, 0.7, 0.68), "teeth": (0.75, 0.72, 0.65), "tongue": (0.5, 0.12, 0.12)}
SKIN = (0.6, 0.38, 0.28)

bpy.ops.wm.obj_import(filepath=file, use_split_groups=True)
points = [one and (one[0], -one[2], one[1]) for one in json.loads(Path(landmarks).read_text())["points"]]
marks = np.array([one for one in points if one])
turned = Path(folder) / "turned.json"
turned.write_text(json.dumps({"points": points}))
objects = [one for one in bpy.data.objects if one.type == "MESH"]
for one in objects:
    one.select_set(True)
bpy.context.view_layer.objects.active = objects[0]
bpy.ops.facepipe.transfer(landmarks=str(turned))

for one in objects:
    material = bpy.data.materials.new(one.name)
    material.use_nodes = True
    color = next((color for name, color in LOOKS.items() if name in one.name), SKIN)
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*color, 1.0)
    one.data.materials.clear()
    one.data.materials.append(material)
    one.data.shade_smooth()
    one.hide_render = "lash" in one.name or (one.data.shape_keys is None and "teeth" not in one.name)

scene = bpy.context.scene
scene.world = bpy.data.worlds.new("World")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.52, 0.55, 1.0)
sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
sun.data.energy, sun.rotation_euler = 2.0, (0.9, 0.1, 0.5)
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
for one in (sun, camera):
    scene.collection.objects.link(one)
scene.camera = camera
middle, size = (marks.max(axis=0) + marks.min(axis=0)) / 2, float(np.ptp(marks[:, 2]))
towards = Vector((0.35, -1.0, 0.05)).normalized()
camera.location = Vector(middle) + Vector((0, 0, 0.15 * size)) + 8.0 * size * towards
camera.rotation_euler = (-towards).to_track_quat("-Z", "Y").to_euler()
camera.data.lens, camera.data.clip_end = 140.0, 1000.0 * size
scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 32
scene.render.resolution_x, scene.render.resolution_y = 300, 340
scene.view_settings.view_transform = "Standard"
for number, weights in enumerate(settings):
    for keys in bpy.data.shape_keys:
        for key in keys.key_blocks:
            if "@" not in key.name:
                key.value = weights.get(key.name, 0.0)
    scene.render.filepath = str(Path(folder) / f"{number}.png")
    bpy.ops.render.render(write_still=True)
