"""A face made in Blender, posed and exported: OUT OPTIONS ANSWER."""

from session import ARGUMENTS, answer, bpy, np, world_points

out, options = ARGUMENTS[:2]
rig = bpy.data.armatures.new("Rig")
armature = bpy.data.objects.new("Rig", rig)
bpy.context.collection.objects.link(armature)
bpy.context.view_layer.objects.active = armature
bpy.ops.object.mode_set(mode="EDIT")
root = rig.edit_bones.new("root")
root.head, root.tail = (0, 0, 0), (0, 0.2, 1)
jaw = rig.edit_bones.new("jaw.L")
jaw.head, jaw.tail, jaw.roll, jaw.parent = (0, 0.2, 1), (0.5, 0.1, 1.5), 0.4, root
bpy.ops.object.mode_set(mode="OBJECT")

bpy.ops.mesh.primitive_grid_add(x_subdivisions=9, y_subdivisions=7, size=2.0)
head = bpy.context.active_object
head.name = "Head"
head.location, head.rotation_euler = (0.1, 0.2, 1.0), (0.3, 0.0, 0.1)
head.parent = armature
head.modifiers.new("Armature", "ARMATURE").object = armature
armature.location, armature.rotation_euler, armature.scale = (1, 2, 3), (0.2, -0.4, 0.6), (2, 2, 2)

rng = np.random.default_rng(0)
count = len(head.data.vertices)
share = rng.random(count)
for name, values in {
    "root": share,
    "jaw.L": 1 - share,
    "mouth": 2 * rng.random(count),
    "chin": rng.random(count),
}.items():
    group = head.vertex_groups.new(name=name)
    for i, value in enumerate(values.tolist()):
        group.add([i], min(value, 1.0), "REPLACE")
head.vertex_groups.new(name="unused")
head.shape_key_add(name="Basis", from_mix=False)
for name in ("smile", "smile@0.5 half", "wide"):
    key = head.shape_key_add(name=name, from_mix=False)
    for i in rng.choice(count, 20, replace=False).tolist():
        key.data[i].co = (np.array(key.data[i].co) + 0.1 * rng.normal(size=3)).tolist()
keys = head.data.shape_keys.key_blocks
keys["smile"].value, keys["smile@0.5 half"].value, keys["wide"].value = 1.0, 0.0, 0.25

armature.pose.bones["jaw.L"].rotation_mode = "XYZ"
armature.pose.bones["jaw.L"].rotation_euler = (0.3, -0.2, 0.5)
armature.pose.bones["root"].location = (0.1, 0.2, -0.1)
bpy.context.view_layer.update()
world = np.array(armature.matrix_world)
names = ["root", "jaw.L"]
answer(
    shown=world_points(head),
    pose=np.array([world @ np.array(armature.pose.bones[name].matrix) for name in names]),
    rest=np.array([world @ np.array(armature.data.bones[name].matrix_local) for name in names]),
)
bpy.ops.wm.usd_export(filepath=out, **options)
