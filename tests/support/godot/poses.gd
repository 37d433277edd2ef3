# Writes what Godot 3 holds of imported GLBs, and how it poses their skeletons: godot3-server --path . -s poses.gd
# request.json is that of ../js/poses.mjs, with `path` and `out` as names in the project's folder. `out` gets JSON in
# its first line, then the numbers of all arrays that the JSON names, float32, in that order.
extends SceneTree

var numbers = StreamPeerBuffer.new()

func _initialize():
	var file = File.new()
	file.open("res://request.json", File.READ)
	var request = parse_json(file.get_as_text())
	file.close()
	for one in request:
		numbers.clear()
		var scene = load("res://" + one.path).instance()
		root.add_child(scene)
		var found = {"meshes": [], "bones": []}
		visit(scene, one.poses, found)
		file.open("res://" + one.out, File.WRITE)
		file.store_line(to_json(found))
		file.store_buffer(numbers.data_array)
		file.close()
		scene.free()
	quit()

func visit(node, poses, found):
	if node is Skeleton:
		for i in node.get_bone_count():
			found.bones.append(node.get_bone_name(i))
		for pose in poses:
			for i in node.get_bone_count():
				var local = transform(pose.joints[node.get_bone_name(i)])
				node.set_bone_pose(i, node.get_bone_rest(i).affine_inverse() * local) # relative to rest
			for i in node.get_bone_count():
				put_transform(node.get_bone_global_pose(i))
	if node is MeshInstance:
		found.meshes.append(dump(node))
	for child in node.get_children():
		visit(child, poses, found)

func dump(node):
	var mesh = node.mesh
	var names = []
	for i in mesh.get_blend_shape_count():
		names.append(mesh.get_blend_shape_name(i))
	var binds = []
	put_transform(node.global_transform)
	for i in node.skin.get_bind_count() if node.skin else 0:
		binds.append(node.skin.get_bind_name(i))
		put_transform(node.skin.get_bind_pose(i))
	var surfaces = []
	for i in mesh.get_surface_count():
		var arrays = mesh.surface_get_arrays(i)
		surfaces.append(arrays[Mesh.ARRAY_VERTEX].size())
		put(arrays[Mesh.ARRAY_VERTEX])
		for shape in mesh.surface_get_blend_shape_arrays(i):
			put(shape[Mesh.ARRAY_VERTEX])
		if node.skin:
			put(PoolRealArray(Array(arrays[Mesh.ARRAY_BONES])))
			put(arrays[Mesh.ARRAY_WEIGHTS])
	return {"name": node.name, "targets": names, "binds": binds, "surfaces": surfaces}

func put(array):
	numbers.put_data(var2bytes(array).subarray(8, -1)) # past type and count

func put_transform(one):
	var rows = []
	for i in 3:
		rows += [one.basis.x[i], one.basis.y[i], one.basis.z[i], one.origin[i]]
	put(PoolRealArray(rows + [0, 0, 0, 1]))

func transform(trs):
	var basis = Basis(Quat(trs[3], trs[4], trs[5], trs[6]))
	return Transform(basis.x * trs[7], basis.y * trs[8], basis.z * trs[9], Vector3(trs[0], trs[1], trs[2]))
