# Runs face.gd of docs/engines.md as it stands, and writes page.json: weights of mouthSmileLeft by mesh, and where the head is.
extends SceneTree

func _initialize():
	var node = Spatial.new()
	node.set_script(load("res://face.gd"))
	root.add_child(node)
	var skeleton = node.face.get_node("Skeleton")
	var shapes = {}
	for mesh in skeleton.get_children():
		shapes[mesh.name] = mesh.get("blend_shapes/mouthSmileLeft")
	var head = skeleton.get_bone_global_pose(skeleton.find_bone("head"))
	var rows = []
	for i in 3:
		rows += [head.basis.x[i], head.basis.y[i], head.basis.z[i], head.origin[i]]
	var file = File.new()
	file.open("res://page.json", File.WRITE)
	file.store_string(to_json({"shapes": shapes, "head": rows}))
	file.close()
	quit()
