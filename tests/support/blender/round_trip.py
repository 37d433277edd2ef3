"""A face imported, shown with some shapes, edited or not, and exported: FACE OUT WEIGHTS EDIT ANSWER."""

from pathlib import Path

from session import ARGUMENTS, answer, bpy, np, world_points

face, out, weights, edit = ARGUMENTS[:4]
bpy.ops.wm.usd_import(filepath=face)
meshes = {one.name: one for one in bpy.data.objects if one.type == "MESH"}
bpy.context.scene.frame_set(5)
played = {f"played {name}": world_points(obj) for name, obj in meshes.items()}
if weights:  # the clip that the face plays would set them again
    for one in (*bpy.data.armatures, *bpy.data.objects, *bpy.data.shape_keys):
        if one.animation_data:
            one.animation_data.action = None
    for keys in bpy.data.shape_keys:
        for key in keys.key_blocks:
            key.value = 0.0
    for one in bpy.data.objects:
        for bone in one.pose.bones if one.pose else ():
            bone.matrix_basis.identity()
for obj in meshes.values():
    for name, weight in weights.items():
        keys = obj.data.shape_keys
        if keys and name in keys.key_blocks:
            keys.key_blocks[name].value = weight
shown = {f"shown {name}": world_points(obj) for name, obj in meshes.items()}
if edit:
    head = meshes["Head"]
    head.data.shape_keys.key_blocks["jawOpen"].data[7].co.z += 0.5
    head.vertex_groups["region:mouth"].add([3], 1.0, "REPLACE")
    head.vertex_groups["region:neck"].add([3], 1.0, "REPLACE")
    meshes["Teeth"].location.z += 0.25
answer(
    frame=bpy.context.scene.frame_current,
    rate=bpy.context.scene.render.fps,
    **played,
    **shown,
    **{
        f"keys {name}": np.array([*obj.data.shape_keys.key_blocks.keys()] if obj.data.shape_keys else [])
        for name, obj in meshes.items()
    },
)
blend = str(Path(out).with_suffix(".blend"))
bpy.ops.wm.save_as_mainfile(filepath=blend)
bpy.ops.wm.open_mainfile(filepath=blend)
bpy.ops.wm.usd_export(filepath=out)
