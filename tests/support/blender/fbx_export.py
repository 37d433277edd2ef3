"""GLB to FBX, moved: GLB FBX OPTIONS ANSWER. Keys of all shapes and bones, and where Blender has the points then.

The answer has `points FRAME NAME` (vertices, 3) of each mesh, metres, Y up, and `frames`.
"""

import math

from session import ARGUMENTS, answer, bpy, np, world_points

FRAMES = (1, 4, 9)
glb, fbx, options = ARGUMENTS[:3]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=glb)
scene = bpy.context.scene
scene.render.fps, scene.frame_start, scene.frame_end = 30, FRAMES[0], FRAMES[-1]
meshes = [one for one in bpy.context.view_layer.objects if one.type == "MESH" and one.find_armature()]
for one in [*bpy.data.objects, *(mesh.data.shape_keys for mesh in meshes if mesh.data.shape_keys)]:
    one.animation_data_clear()
for mesh in meshes:
    for place, key in enumerate(mesh.data.shape_keys.key_blocks[1:] if mesh.data.shape_keys else ()):
        for frame, weight in zip(FRAMES, (0.0, 1.0 if place % 2 else 0.3, 0.5), strict=True):
            key.value = weight
            key.keyframe_insert("value", frame=frame)
for armature in [one for one in bpy.data.objects if one.type == "ARMATURE"]:
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
        for frame, angle in zip(FRAMES, (0.0, 0.3, -0.2), strict=True):
            bone.rotation_quaternion = (math.cos(angle / 2), 0.6 * math.sin(angle / 2), 0.8 * math.sin(angle / 2), 0)
            bone.keyframe_insert("rotation_quaternion", frame=frame)
for one in [one for one in bpy.data.objects if one.type == "MESH" and one not in meshes]:
    bpy.data.objects.remove(one)  # what Blender shows bones as
bpy.ops.export_scene.fbx(filepath=fbx, bake_anim_simplify_factor=0.0, **options)
found = {"frames": np.array(FRAMES)}
for frame in FRAMES:
    scene.frame_set(frame)
    for mesh in meshes:
        points = world_points(mesh)
        found[f"points {frame} {mesh.name}"] = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
answer(**found)
