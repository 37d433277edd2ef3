"""Blendshapes of a mesh as parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Usd, UsdSkel

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import SchemaError, TopologyError
from facepipe.parts import Blendshape, Inbetween
from facepipe.stage.display_names import label
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, ints

MOST_INBETWEENS = 100  # of a shape: each is a curve through the weights of all


@reads_prim
def read_blendshapes(prim: Usd.Prim, points: int) -> tuple[Blendshape, ...]:
    """The blendshapes bound to a mesh, in the order of skel:blendShapes.

    :raises SchemaError: names and targets that don't pair, a dangling target, a shape name twice
    :raises TopologyError: indices or offsets that don't fit the mesh
    """
    api = UsdSkel.BindingAPI(prim)
    names = [str(name) for name in api.GetBlendShapesAttr().Get() or []]
    targets = api.GetBlendShapeTargetsRel().GetTargets()
    if len(names) != len(targets):
        raise SchemaError(prim.GetPath(), f"{len(names)} skel:blendShapes and {len(targets)} targets, expected as many")
    if len(set(names)) != len(names):
        raise SchemaError(prim.GetPath(), "a name stands twice in skel:blendShapes")
    return tuple(
        _read(UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(target)), str(target), name, points)
        for name, target in zip(names, targets, strict=True)
    )


def _read(shape: UsdSkel.BlendShape, where: str, name: str, points: int) -> Blendshape:
    if not shape:
        raise SchemaError(where, f"no BlendShape there, expected the target of '{name}'")
    authored = shape.GetPointIndicesAttr().Get()
    offsets = floats(shape.GetOffsetsAttr().Get(), 3)
    others = _other_offsets(shape)
    count = len(offsets) or max(others, default=0)
    indices = ints(authored) if authored else np.arange(count, dtype=np.int32)
    if not authored and count not in (0, points):
        raise TopologyError(where, f"{count} offsets without pointIndices, expected {points}")
    if others and not len(offsets):  # UsdSkel moves no point by the shape itself
        offsets = np.zeros((len(indices), 3), np.float32)
    if indices.size and not (indices.min() >= 0 and indices.max() < points):
        raise TopologyError(where, f"pointIndices outside 0..{points - 1}")
    unique, place = np.unique(indices, return_inverse=True)
    merge = _Merge(where, len(indices), len(unique), place)
    return Blendshape(
        name=name,
        point_indices=unique.astype(np.int32),
        offsets=merge("offsets", offsets),
        normal_offsets=merge.optional("normalOffsets", shape.GetNormalOffsetsAttr().Get()),
        inbetweens=_inbetweens(shape, merge),
        label=label(shape.GetPrim(), name) if shape.GetPrim().HasAuthoredDisplayName() else None,
    )


def _other_offsets(shape: UsdSkel.BlendShape) -> list[int]:
    """How many normal offsets and offsets of inbetweens a shape has, where it has some."""
    arrays = [shape.GetNormalOffsetsAttr().Get()]
    for one in shape.GetInbetweens():
        arrays += [one.GetOffsets(), one.GetNormalOffsets()]
    return [len(array) for array in arrays if array]


def _inbetweens(shape: UsdSkel.BlendShape, merge: _Merge) -> tuple[Inbetween, ...]:
    found = []
    inbetweens = shape.GetInbetweens()
    if len(inbetweens) > MOST_INBETWEENS:
        raise SchemaError(merge.where, f"{len(inbetweens)} inbetweens, expected at most {MOST_INBETWEENS}")
    for one in inbetweens:
        name = one.GetAttr().GetName().removeprefix("inbetweens:")
        weight = one.GetWeight()
        where = f"{merge.where}.inbetweens:{name}"
        if weight is None or not np.isfinite(weight) or weight in (0.0, 1.0):
            raise SchemaError(where, f"weight {weight}, expected a number other than 0 and 1")
        normals = one.GetNormalOffsets()
        found.append(
            Inbetween(
                name=name,
                weight=float(weight),
                offsets=_inbetween_offsets(merge, name, one),
                normal_offsets=merge.optional(f"inbetweens:{name}:normalOffsets", normals),
            )
        )
    if len({one.weight for one in found}) != len(found):
        raise SchemaError(merge.where, "two inbetweens have one weight")
    return tuple(sorted(found, key=lambda one: one.weight))


def _inbetween_offsets(merge: _Merge, name: str, one: UsdSkel.InbetweenShape) -> FloatArray:
    """Zeros for an inbetween that turns normals alone."""
    offsets = floats(one.GetOffsets(), 3)
    if not len(offsets) and one.GetNormalOffsets():
        offsets = np.zeros((merge.count, 3), np.float32)
    return merge(f"inbetweens:{name}", offsets)


class _Merge:
    """Sorts what is parallel to pointIndices; offsets of a point named twice add up, as UsdSkel applies them."""

    def __init__(self, where: str, count: int, unique: int, place: IntArray) -> None:
        self.where, self.count, self.unique, self.place = where, count, unique, place
        self.sorted = count == unique and bool((place == np.arange(count)).all())

    def __call__(self, what: str, offsets: FloatArray) -> FloatArray:
        if len(offsets) != self.count:
            raise TopologyError(f"{self.where}.{what}", f"{len(offsets)} offsets, expected {self.count}")
        if not np.isfinite(offsets).all():
            raise SchemaError(f"{self.where}.{what}", "NaN or infinity, expected finite numbers")
        if self.sorted:
            return offsets
        merged = np.zeros((self.unique, 3), dtype=np.float32)
        np.add.at(merged, self.place, offsets)
        return merged

    def optional(self, what: str, value: Any) -> FloatArray | None:
        return self(what, floats(value, 3)) if value else None
