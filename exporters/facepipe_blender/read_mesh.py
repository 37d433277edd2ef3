"""A mesh object of Blender as a mesh of a face, in the space of the object: modifiers applied, shape keys and all."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FacepipeError, InputError
from facepipe.hosting.host_face import check_region_name, sculpted
from facepipe.parts import Blendshape, MaterialFaces, Mesh, Skin, UvSet, bindings

from .write_mesh import REGION, SUBSET, read_key_name

_SMOOTH = 1e-4  # corner normals of a point nearer than this are one


def read_mesh(obj: Any, name: str, joints: Mapping[str, int], uv_names: Mapping[str, str], warnings: list[str]) -> Mesh:
    """The undeformed mesh of an object with all that Blender holds of it.

    :param joints: index of every bone by its name
    :param uv_names: name in USD of every UV map
    :param warnings: gets a line for what is left out
    :raises InputError: no faces, or shape keys of more than their mesh
    """
    editing = obj.data.is_editmode
    if editing:
        obj.update_from_editmode()
    if not len(obj.data.polygons):
        raise InputError(obj.name, "no faces, expected a mesh with some")
    keys = obj.data.shape_keys.key_blocks if obj.data.shape_keys else ()
    helpers = {str(getattr(one, "vertex_group", "")) for one in (*obj.modifiers, *keys)}
    with with_modifiers(obj, warnings) as shown:
        editing = editing and shown == obj
        data = obj.to_mesh() if editing else shown.data  # a mesh in edit mode shows no values of UV maps and attributes
        try:
            return _read(shown, data, name, joints, uv_names, helpers, warnings)
        finally:
            if editing:
                obj.to_mesh_clear()


def read_undeformed(obj: Any, joints: Mapping[str, int]) -> Mesh:
    """Points, faces, colours, shapes and skin of an object before any modifier, called as the object.

    :param joints: as of `read_mesh`
    """
    mesh = _read(obj, obj.data, str(obj.name), joints, {}, set(), [])
    return replace(mesh, normals=None, regions={}, point_subsets={}, material=None, material_faces=())


def _read(
    obj: Any,
    data: Any,
    name: str,
    joints: Mapping[str, int],
    uv_names: Mapping[str, str],
    helpers: set[str],
    warnings: list[str],
) -> Mesh:
    bones, regions, others = _groups(obj, {*joints}, helpers)
    if others:
        warnings.append(f"{obj.name}: vertex groups {_listed(others)} name no region: left out")
    bare = int(np.sum(~np.any([mask > 0 for mask in regions.values()], axis=0))) if regions else 0
    if bare:
        warnings.append(f"{obj.name}: {bare} points are in no region, expected each in one or more")
    points, shapes = _shapes(obj, warnings)
    counts = _values(data.polygons, "loop_total", np.int32)
    corners = _values(data.loops, "vertex_index", np.int32)
    material, by_face = _materials(obj)
    uv_sets = []
    for layer in data.uv_layers:
        if layer.name in uv_names:
            values, indices = np.unique(_values(layer.uv, "vector", np.float32, 2), axis=0, return_inverse=True)
            indices = indices.reshape(-1).astype(np.int32)
            uv_sets.append(UvSet(name=uv_names[layer.name], values=values, indices=indices))
    colors = data.color_attributes.get("displayColor") or data.color_attributes.active_color
    has_colors = colors is not None and colors.domain == "POINT"
    subsets = {}
    for layer in data.attributes:
        if layer.name.startswith(SUBSET) and (layer.domain, layer.data_type) == ("POINT", "BOOLEAN"):
            chosen = np.flatnonzero(_values(layer.data, "value", bool)).astype(np.int32)
            subsets[layer.name.removeprefix(SUBSET)] = chosen
    return Mesh(
        name=name,
        points=points,
        face_vertex_counts=counts,
        face_vertex_indices=corners,
        normals=_normals(data, corners),
        uv_sets=tuple(uv_sets),
        colors=np.asarray(_values(colors.data, "color", np.float32, 4)[:, :3]) if has_colors else None,
        skin=_skin(obj, bones, joints, warnings),
        blendshapes=shapes,
        regions={region: mask.astype(np.float32) for region, mask in regions.items()},
        point_subsets=subsets,
        material=material,
        material_faces=by_face,
        double_sided=True,
    )


def _values(items: Any, field: str, kind: Any, width: int = 1) -> Any:
    found = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(field, found)
    return found.reshape(-1, width) if width > 1 else found


def _groups(
    obj: Any, bones: set[str], helpers: set[str]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], list[str]]:
    """Weights (n,) of the vertex groups of bones and of regions, and the names of the groups that are neither.

    Groups called ``region:NAME`` are regions; where there are none, all groups with weights that are no bones and serve
    no modifier or shape key.

    :param helpers: names of those that serve modifiers and shape keys
    """
    table = np.zeros((len(obj.vertex_groups), len(obj.data.vertices)))
    for index, vertex in enumerate(obj.data.vertices):
        for entry in vertex.groups:
            if entry.group < len(table):
                table[entry.group, index] = entry.weight
    weights = {group.name: values for group, values in zip(obj.vertex_groups, table, strict=True)}
    free = {name: values for name, values in weights.items() if name not in bones}
    marked = {name: values for name, values in free.items() if name.startswith(REGION)}
    regions: dict[str, FloatArray] = {}
    for name, values in (marked or {name: free[name] for name in free if name not in helpers}).items():
        with contextlib.suppress(FacepipeError):  # a name that no region can have
            check_region_name(name, name.removeprefix(REGION))
            if values.any() or name.startswith(REGION):
                regions[name.removeprefix(REGION)] = values
    others = [name for name in free if name.removeprefix(REGION) not in regions and name not in helpers]
    return {name: weights[name] for name in weights if name in bones}, regions, others


def _shapes(obj: Any, warnings: list[str]) -> tuple[FloatArray, tuple[Blendshape, ...]]:
    """Points (n, 3) of the basis, and the shapes."""
    data = obj.data
    if data.shape_keys is None:
        return _values(data.vertices, "co", np.float32, 3), ()
    if not data.shape_keys.use_relative:
        warnings.append(f"{obj.name}: absolute shape keys are taken as relative ones")
    blocks = data.shape_keys.key_blocks
    if any(len(block.data) != len(data.vertices) for block in blocks):
        raise InputError(obj.name, "shape keys of another number of points than the mesh, expected as many")
    places = {block.name: _values(block.data, "co", np.float32, 3) for block in blocks}
    basis = data.shape_keys.reference_key
    dense: dict[str, FloatArray] = {}  # (n, 3) what each key adds at value 1
    for block in blocks:
        if block != basis:
            offsets = places[block.name].astype(np.float64) - places[block.relative_key.name]
            group = obj.vertex_groups.get(block.vertex_group) if block.vertex_group else None
            if group is not None:
                mask = np.zeros(len(offsets))
                for index, vertex in enumerate(data.vertices):
                    mask[index] = sum(entry.weight for entry in vertex.groups if entry.group == group.index)
                offsets *= mask[:, None]
            dense[block.name] = offsets
    names = {name: read_key_name(name) for name in dense}
    between: dict[str, dict[str, tuple[float, FloatArray]]] = {}
    for name, (shape, weight, inbetween) in names.items():
        if weight is None:
            continue
        if shape not in dense:
            warnings.append(f"{obj.name}: shape key '{name}' left out, there is no shape key '{shape}'")
            continue
        # Blender adds keys up: an inbetween's key holds inbetween - weight * shape
        between.setdefault(shape, {})[inbetween] = (weight, dense[name] + weight * dense[shape])
    own = [name for name, (_, weight, _) in names.items() if weight is None]
    return places[basis.name], tuple(sculpted(name, dense[name], between.get(name, {})) for name in own)


def _skin(obj: Any, bones: Mapping[str, FloatArray], joints: Mapping[str, int], warnings: list[str]) -> Skin | None:
    if not joints:
        return None
    count = len(obj.data.vertices)
    if not bones:
        bone = obj.parent_bone if obj.parent_type == "BONE" else ""
        if bone not in joints:
            return None
        return Skin(joint_indices=np.full((count, 1), joints[bone], np.int32), joint_weights=np.ones((count, 1)))
    names = sorted(bones, key=joints.__getitem__)
    table = np.array([bones[name] for name in names]).T
    total = table.sum(axis=1)
    if lost := int((total <= 0).sum()):
        warnings.append(f"{obj.name}: {lost} points without weight now follow the first joint")
    width = max(int((table > 0).sum(axis=1).max()), 1)
    order = np.argsort(-table, axis=1, kind="stable")[:, :width]
    weights = np.take_along_axis(table, order, axis=1)
    indices = np.array([joints[name] for name in names], dtype=np.int32)[order]
    weights[total <= 0, 0], indices[total <= 0, 0] = 1.0, 0
    indices[weights <= 0] = 0
    # vertex groups need not sum to 1: the Armature modifier divides by the sum, and so does this
    weights /= weights.sum(axis=1, keepdims=True)
    return Skin(joint_indices=indices.astype(np.int32), joint_weights=weights.astype(np.float32))


def _normals(data: Any, corners: IntArray) -> FloatArray:
    """Normals per point where those of its corners agree, else per corner."""
    normals: FloatArray = _values(data.corner_normals, "vector", np.float32, 3)
    first = np.zeros((len(data.vertices), 3), dtype=np.float32)
    first[corners[::-1]] = normals[::-1]
    if np.abs(first[corners] - normals).max(initial=0.0) > _SMOOTH:
        return normals
    loose = ~first.any(axis=1)
    first[loose] = (0.0, 0.0, 1.0)
    return first


def _materials(obj: Any) -> tuple[str | None, tuple[MaterialFaces, ...]]:
    names = [slot.material.name if slot.material else None for slot in obj.material_slots]
    slots = np.minimum(_values(obj.data.polygons, "material_index", np.int32), max(len(names) - 1, 0))
    return bindings(names, slots)


@contextlib.contextmanager
def with_modifiers(obj: Any, warnings: list[str]) -> Iterator[Any]:
    """The mesh object with its modifiers applied to each shape key: all but Armature that the viewport shows.

    It is a copy, removed after the block; the object itself where there are no modifiers, or they can't be applied.

    :param warnings: gets a line for what is not applied
    """
    modifiers = [
        modifier
        for modifier in obj.modifiers
        if modifier.type != "ARMATURE" and (modifier.show_viewport or modifier.show_render)
    ]
    hidden = [modifier.name for modifier in modifiers if not modifier.show_viewport]
    if hidden:
        warnings.append(f"{obj.name}: modifiers {_listed(hidden)} are not applied, the viewport doesn't show them")
    if len(hidden) == len(modifiers):
        yield obj
        return
    with contextlib.ExitStack() as after:
        # Blender's own USD export may run beside the main thread, where no objects can be made
        made = _applied(obj, after) if threading.current_thread() is threading.main_thread() else None
        if made is None:
            names = _listed([modifier.name for modifier in modifiers if modifier.show_viewport])
            why = "they make other points of some shape key"
            if threading.current_thread() is not threading.main_thread():
                why = "Blender exports in the background (Export GLB + ONNX applies them)"
            warnings.append(f"{obj.name}: modifiers {names} are not applied, {why}")
        yield made or obj


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:3])} ({len(names)} in all)"


def _applied(obj: Any, after: contextlib.ExitStack) -> Any:
    """A copy of the object whose mesh and keys are as modified; None where a key has other points then."""
    work = _copy(obj, obj.data.copy(), after)
    for modifier in [one for one in work.modifiers if one.type == "ARMATURE" or not one.show_viewport]:
        work.modifiers.remove(modifier)
    keys = work.data.shape_keys
    blocks = [] if keys is None else [one for one in keys.key_blocks if one != keys.reference_key]
    if keys is not None:
        keys.use_relative = True
        keys.animation_data_clear()
    for block in blocks:
        block.slider_min, block.slider_max, block.value, block.mute = 0.0, 1.0, 0.0, False
    bpy.context.scene.collection.objects.link(work)
    mesh = bpy.data.meshes.new_from_object(
        _evaluated(work), preserve_all_data_layers=True, depsgraph=bpy.context.evaluated_depsgraph_get()
    )
    made = _copy(obj, mesh, after)
    made.modifiers.clear()
    if mesh.shape_keys is not None:
        made.shape_key_clear()
    names = ["Basis"] if keys is None else [keys.reference_key.name]
    if blocks:
        made.shape_key_add(name=names[0], from_mix=False)
    for block in blocks:
        block.value = 1.0
        data = _evaluated(work).data
        points = np.empty(3 * len(data.vertices), dtype=np.float32)
        data.vertices.foreach_get("co", points)
        block.value = 0.0
        # a modifier may make other points of each key (decimate, weld): these are no offsets
        if len(points) != 3 * len(mesh.vertices):
            return None
        added = made.shape_key_add(name=block.name, from_mix=False)
        added.data.foreach_set("co", points)
    return made


def _copy(obj: Any, data: Any, after: contextlib.ExitStack) -> Any:
    """A copy of an object with other data, both gone in the end."""
    made = obj.copy()
    made.data = data
    made.animation_data_clear()
    after.callback(bpy.data.meshes.remove, data)
    after.callback(bpy.data.objects.remove, made)
    return made


def _evaluated(obj: Any) -> Any:
    bpy.context.view_layer.update()
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
