"""A mesh of a face written on a mesh object of Blender: points, shape keys, regions, point subsets."""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Blendshape, Mesh

from .groups import SUBSET, write_regions
from .inbetween_keys import expressions, key_name

_DROPPED = ("facepipe:region:", "facepipe_region_", "skel:joint")  # attributes that are vertex groups too


def write_mesh(obj: Any, mesh: Mesh) -> None:
    """Write points, shapes, regions and point subsets of a mesh of the same points on an object."""
    flat = np.ascontiguousarray(mesh.points, dtype=np.float32).ravel()
    there = np.empty_like(flat)
    obj.data.vertices.foreach_get("co", there)
    if not np.array_equal(there, flat):  # custom normals stay as they are
        obj.data.vertices.foreach_set("co", flat)
    if mesh.blendshapes:
        _write_shapes(obj, mesh)
    write_regions(obj, dict(mesh.regions))
    _remove_attributes(obj.data, _DROPPED)
    _remove_attributes(obj.data, (SUBSET,))
    for name, indices in mesh.point_subsets.items():
        mask = np.zeros(len(obj.data.vertices), dtype=bool)
        mask[indices] = True
        obj.data.attributes.new(SUBSET + name, "BOOLEAN", "POINT").data.foreach_set("value", mask)
    obj.data.update()


def _remove_attributes(data: Any, prefixes: tuple[str, ...]) -> None:
    names = [attribute.name for attribute in data.attributes if attribute.name.startswith(prefixes)]
    for name in names:  # references to others end with every removal
        data.attributes.remove(data.attributes[name])


def _write_shapes(obj: Any, mesh: Mesh) -> None:
    """Shape keys of exactly the shapes of the mesh, in their order; values and drivers of those there stay."""
    if obj.data.shape_keys is None:
        obj.shape_key_add(name="Basis", from_mix=False)
    keys = obj.data.shape_keys
    basis = keys.reference_key
    points = np.asarray(mesh.points, dtype=np.float64)
    _set(basis, points)
    wanted = {shape.name: (shape, None) for shape in mesh.blendshapes}
    between = {
        key_name(shape.name, inbetween.weight, inbetween.name): (shape, inbetween)
        for shape in mesh.blendshapes
        for inbetween in shape.inbetweens
    }
    gone = [one.name for one in keys.key_blocks if one != basis and one.name not in {*wanted, *between}]
    for name in gone:
        obj.shape_key_remove(keys.key_blocks[name])
    for name, (shape, inbetween) in {**wanted, **between}.items():
        block = keys.key_blocks.get(name) or _added(obj, name)
        block.relative_key = basis
        offsets = np.asarray(shape.offsets, dtype=np.float64)
        if inbetween is not None:
            # Blender adds keys up, and the shape itself is on by the weight there: the key holds the rest alone
            offsets = np.asarray(inbetween.offsets, dtype=np.float64) - inbetween.weight * offsets
        moved = points.copy()
        moved[shape.point_indices] += offsets
        _set(block, moved)
    for shape in mesh.blendshapes:
        _drive(keys, shape)


def _added(obj: Any, name: str) -> Any:
    block = obj.shape_key_add(name=name, from_mix=False)
    block.value = 0.0
    return block


def _set(block: Any, points: FloatArray) -> None:
    block.data.foreach_set("co", np.ascontiguousarray(points, dtype=np.float32).ravel())


def _drive(keys: Any, shape: Blendshape) -> None:
    """Drivers that give the keys of inbetweens their activation."""
    formulas = expressions(tuple(one.weight for one in shape.inbetweens), "value")
    for inbetween in shape.inbetweens:
        block = keys.key_blocks[key_name(shape.name, inbetween.weight, inbetween.name)]
        block.slider_min, block.slider_max = -10.0, 10.0  # an activation may lie outside 0 to 1
        block.driver_remove("value")
        driver = block.driver_add("value").driver
        driver.type = "SCRIPTED"
        variable = driver.variables.new()
        variable.name, variable.type = "value", "SINGLE_PROP"
        target = variable.targets[0]
        target.id_type, target.id = "KEY", keys
        target.data_path = f'key_blocks["{_escaped(shape.name)}"].value'
        driver.expression = formulas[inbetween.weight]


def _escaped(name: str) -> str:
    return name.replace("\\", "\\\\").replace('"', '\\"')
