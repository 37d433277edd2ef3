"""A mesh object of Blender as a mesh of a face, in the space of the object."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.hosting.host_face import sculpted
from facepipe.parts import Blendshape, MaterialFaces, Mesh, Skin, UvSet

from .groups import SUBSET, helper_groups, read_groups
from .inbetween_keys import read_key_name
from .modifiers import with_modifiers

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
    helpers = helper_groups(obj)
    with with_modifiers(obj, warnings) as shown:
        editing = editing and shown == obj
        data = obj.to_mesh() if editing else shown.data  # a mesh in edit mode shows no values of UV maps and attributes
        try:
            return _read(shown, data, name, joints, uv_names, helpers, warnings)
        finally:
            if editing:
                obj.to_mesh_clear()


def _read(
    obj: Any,
    data: Any,
    name: str,
    joints: Mapping[str, int],
    uv_names: Mapping[str, str],
    helpers: set[str],
    warnings: list[str],
) -> Mesh:
    groups = read_groups(obj, {*joints}, helpers)
    if groups.others:
        listed = ", ".join(groups.others[:3])
        warnings.append(f"{obj.name}: vertex groups {listed} ({len(groups.others)} in all) name no region: left out")
    bare = int(np.sum(~np.any([mask > 0 for mask in groups.regions.values()], axis=0))) if groups.regions else 0
    if bare:
        warnings.append(f"{obj.name}: {bare} points are in no region, expected each in one or more")
    points, shapes = _shapes(obj, warnings)
    counts = _values(data.polygons, "loop_total", np.int32)
    corners = _values(data.loops, "vertex_index", np.int32)
    material, by_face = _materials(obj)
    return Mesh(
        name=name,
        points=points,
        face_vertex_counts=counts,
        face_vertex_indices=corners,
        normals=_normals(data, corners),
        uv_sets=tuple(_uv_set(layer, uv_names[layer.name]) for layer in data.uv_layers if layer.name in uv_names),
        colors=_colors(data),
        skin=_skin(obj, groups.bones, joints, warnings),
        blendshapes=shapes,
        regions={region: mask.astype(np.float32) for region, mask in groups.regions.items()},
        point_subsets=_subsets(data),
        material=material,
        material_faces=by_face,
        double_sided=True,
    )


def _values(items: Any, field: str, kind: Any, width: int = 1) -> Any:
    found = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(field, found)
    return found.reshape(-1, width) if width > 1 else found


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
    dense = {block.name: _offsets(obj, block, places) for block in blocks if block != basis}
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


def _offsets(obj: Any, block: Any, places: Mapping[str, FloatArray]) -> FloatArray:
    """(n, 3) what a key adds at value 1."""
    offsets = places[block.name].astype(np.float64) - places[block.relative_key.name]
    group = obj.vertex_groups.get(block.vertex_group) if block.vertex_group else None
    if group is not None:
        mask = np.zeros(len(offsets))
        for index, vertex in enumerate(obj.data.vertices):
            mask[index] = sum(entry.weight for entry in vertex.groups if entry.group == group.index)
        offsets *= mask[:, None]
    return offsets


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


def _uv_set(layer: Any, name: str) -> UvSet:
    values, indices = np.unique(_values(layer.uv, "vector", np.float32, 2), axis=0, return_inverse=True)
    return UvSet(name=name, values=values, indices=indices.reshape(-1).astype(np.int32))


def _colors(data: Any) -> FloatArray | None:
    layer = data.color_attributes.get("displayColor") or data.color_attributes.active_color
    if layer is None or layer.domain != "POINT":
        return None
    return np.asarray(_values(layer.data, "color", np.float32, 4)[:, :3])


def _subsets(data: Any) -> dict[str, IntArray]:
    layers = [attribute for attribute in data.attributes if attribute.name.startswith(SUBSET)]
    return {
        layer.name.removeprefix(SUBSET): np.flatnonzero(_values(layer.data, "value", bool)).astype(np.int32)
        for layer in layers
        if (layer.domain, layer.data_type) == ("POINT", "BOOLEAN")
    }


def _materials(obj: Any) -> tuple[str | None, tuple[MaterialFaces, ...]]:
    names = [slot.material.name if slot.material else None for slot in obj.material_slots]
    if not any(names):
        return None, ()
    slots = np.minimum(_values(obj.data.polygons, "material_index", np.int32), len(names) - 1)
    used = np.unique(slots).tolist()
    if len(used) == 1:
        return names[used[0]], ()
    faces: dict[str, list[IntArray]] = {}
    for slot in used:
        if name := names[slot]:
            faces.setdefault(name, []).append(np.flatnonzero(slots == slot))
    return None, tuple(
        MaterialFaces(material=name, faces=np.sort(np.concatenate(own)).astype(np.int32)) for name, own in faces.items()
    )
