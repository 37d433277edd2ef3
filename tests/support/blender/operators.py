"""Operators run on an imported face: FACE STEPS ANSWER. A step is [operator, settings]; its message is answered."""

from session import ARGUMENTS, answer, bpy, np, world_points

face, steps = ARGUMENTS[:2]
if face:
    bpy.ops.wm.usd_import(filepath=face)
    bpy.context.view_layer.objects.active = bpy.data.objects["Head"]
else:
    bpy.ops.mesh.primitive_cube_add()
said = []
for name, settings in steps:
    operator = getattr(bpy.ops.object if name == "mode_set" else bpy.ops.facepipe, name)
    try:
        operator(**settings)
        said.append("")
    except RuntimeError as error:  # Blender raises what an operator reports as an error
        said.append(str(error).strip())
points = {f"points {one.name}": world_points(one) for one in bpy.data.objects if one.type == "MESH"}
answer(said=np.array(said), mode=bpy.context.active_object.mode, **points)
