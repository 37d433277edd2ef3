"""Meshes of a face on mesh objects of Blender: how shape keys and vertex groups are called, and all of it written.

Inbetweens are shape keys: ``jawOpen@0.5 half`` holds what the inbetween ``half`` adds to half of ``jawOpen``. A driver
gives such a key the activation that USD gives the inbetween, so that Blender shows the sum that USD means: with the
shape at w, offsets D, and inbetweens I_i at w_i of activation a_i(w), the sum ``w D + a_i (I_i - w_i D)`` is USD's
``a_1 D + a_i I_i``, since piecewise linear interpolation reproduces w itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.names import identifier
from facepipe.hosting.host_face import curves
from facepipe.parts import Blendshape, Inbetween, Mesh, Skin

REGION = "region:"  # before the name of a region, since bones are called `chin` too
SUBSET = "subset:"  # before the name of a point subset, of boolean point attributes
_MARK = "@"  # between the name of a shape and the weight of its inbetween
_DROPPED = ("facepipe:region:", "facepipe_region_", "skel:joint", SUBSET)  # attributes that are vertex groups too


class KeyName(NamedTuple):
    """What the name of a shape key says; `weight` None for a shape itself."""

    shape: str
    weight: float | None = None
    inbetween: str = ""


def key_name(shape: str, weight: float, inbetween: str) -> str:
    """The name of the key of an inbetween."""
    return f"{shape}{_MARK}{weight:.7g} {inbetween}"


def read_key_name(name: str) -> KeyName:
    """What a key's name says; one without a weight after the mark is a shape itself."""
    shape, mark, rest = name.rpartition(_MARK)
    number, _, inbetween = rest.partition(" ")
    try:
        weight = float(number)
    except ValueError:
        return KeyName(name)
    if not mark or not shape or weight in (0.0, 1.0) or not abs(weight) < 1e6:
        return KeyName(name)
    return KeyName(shape, weight, inbetween.strip() or identifier(f"at_{number}"))


def expressions(weights: tuple[float, ...], variable: str) -> dict[float, str]:
    """Driver expression of every inbetween weight of a shape, of what Blender evaluates without Python."""
    found: dict[float, str] = {}
    for weight, curve in curves(weights).items():
        if weight != 1.0:
            base, slope, bends = curve.hinges()
            terms = [f"{base:.9g} + {slope:.9g}*{variable}"]
            terms += [f"{change:.9g}*max({variable} - {at:.9g}, 0)" for at, change in bends]
            found[weight] = " + ".join(terms)
    return found


def write_mesh(obj: Any, mesh: Mesh) -> None:
    """Write points, shapes, regions and point subsets of a mesh of the same points on an object."""
    flat = np.ascontiguousarray(mesh.points, dtype=np.float32).ravel()
    there = np.empty_like(flat)
    obj.data.vertices.foreach_get("co", there)
    if not np.array_equal(there, flat):  # custom normals stay as they are
        obj.data.vertices.foreach_set("co", flat)
    if mesh.blendshapes:
        _write_shapes(obj, mesh)
    _remove(obj, [group.name for group in obj.vertex_groups if group.name.startswith(REGION)])
    _add(obj, {REGION + name: mask for name, mask in mesh.regions.items()})
    for name in [one.name for one in obj.data.attributes if one.name.startswith(_DROPPED)]:
        obj.data.attributes.remove(obj.data.attributes[name])  # references to others end with every removal
    for name, indices in mesh.point_subsets.items():
        mask = np.zeros(len(obj.data.vertices), dtype=bool)
        mask[indices] = True
        obj.data.attributes.new(SUBSET + name, "BOOLEAN", "POINT").data.foreach_set("value", mask)
    obj.data.update()


def _write_shapes(obj: Any, mesh: Mesh) -> None:
    """Shape keys of exactly the shapes of the mesh, in their order; values and drivers of those there stay."""
    if obj.data.shape_keys is None:
        obj.shape_key_add(name="Basis", from_mix=False)
    keys = obj.data.shape_keys
    basis = keys.reference_key
    _set(basis, np.asarray(mesh.points, dtype=np.float64))
    wanted = _sculpts(mesh.blendshapes)
    gone = [one.name for one in keys.key_blocks if one != basis and one.name not in wanted]
    for name in gone:
        obj.shape_key_remove(keys.key_blocks[name])
    add_shapes(obj, mesh.blendshapes)


def _sculpts(shapes: Sequence[Blendshape]) -> dict[str, tuple[Blendshape, Inbetween | None]]:
    """Name of a key -> what it holds."""
    between = {
        key_name(shape.name, inbetween.weight, inbetween.name): (shape, inbetween)
        for shape in shapes
        for inbetween in shape.inbetweens
    }
    return {**{shape.name: (shape, None) for shape in shapes}, **between}


def add_shapes(obj: Any, shapes: Sequence[Blendshape]) -> None:
    """Shape keys of shapes, beside those of other names; values and drivers of those of the same names stay."""
    if obj.data.shape_keys is None:
        obj.shape_key_add(name="Basis", from_mix=False)
    keys = obj.data.shape_keys
    basis = keys.reference_key
    flat = np.empty(3 * len(basis.data), dtype=np.float32)
    basis.data.foreach_get("co", flat)
    points = flat.reshape(-1, 3).astype(np.float64)
    for name, (shape, inbetween) in _sculpts(shapes).items():
        block = keys.key_blocks.get(name)
        if block is None:
            block = obj.shape_key_add(name=name, from_mix=False)
            block.value = 0.0
        block.relative_key = basis
        offsets = np.asarray(shape.offsets, dtype=np.float64)
        if inbetween is not None:
            # Blender adds keys up, and the shape itself is on by the weight there: the key holds the rest alone
            offsets = np.asarray(inbetween.offsets, dtype=np.float64) - inbetween.weight * offsets
        moved = points.copy()
        moved[shape.point_indices] += offsets
        _set(block, moved)
    for shape in shapes:
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
            escaped = shape.name.replace("\\", "\\\\").replace('"', '\\"')
            target.data_path = f'key_blocks["{escaped}"].value'
            driver.expression = formulas[inbetween.weight]


def _set(block: Any, points: FloatArray) -> None:
    block.data.foreach_set("co", np.ascontiguousarray(points, dtype=np.float32).ravel())


def write_skin(obj: Any, skin: Skin, bones: Sequence[str]) -> None:
    """The weights of a skin as vertex groups of a mesh object, in place of those of its bones.

    :param bones: name of the bone of every joint
    """
    _remove(obj, [group.name for group in obj.vertex_groups if group.name in set(bones)])
    weights: dict[str, FloatArray] = {}
    for joint in np.unique(skin.joint_indices[skin.joint_weights != 0]).tolist():
        weights[bones[joint]] = np.where(skin.joint_indices == joint, skin.joint_weights, 0.0).sum(axis=1)
    _add(obj, weights)


def _remove(obj: Any, names: Sequence[str]) -> None:
    for name in names:
        obj.vertex_groups.remove(obj.vertex_groups[name])


def _add(obj: Any, groups: Mapping[str, FloatArray]) -> None:
    for name, mask in groups.items():
        group = obj.vertex_groups.new(name=name)
        values = np.asarray(mask, dtype=np.float64)
        for value in np.unique(values[values != 0]):
            group.add(np.flatnonzero(values == value).tolist(), float(value), "REPLACE")
