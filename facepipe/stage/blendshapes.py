"""Blendshapes of a mesh: read as parts, and authored from them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdSkel, Vt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import SchemaError, TopologyError
from facepipe.core.names import unique_identifiers
from facepipe.parts import Blendshape, Inbetween
from facepipe.stage.api_schemas import put
from facepipe.stage.guard import reads_prim
from facepipe.stage.prims import author_name, editable, label
from facepipe.stage.values import check_inside, floats, ints, same, to_ints, to_vec3f

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
        raise SchemaError(prim.GetPath(), "a name occurs twice in skel:blendShapes")
    return tuple(
        _read(UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(target)), str(target), name, points)
        for name, target in zip(names, targets, strict=True)
    )


def _read(shape: UsdSkel.BlendShape, where: str, name: str, points: int) -> Blendshape:
    if not shape:
        raise SchemaError(where, f"no BlendShape there, expected the target of '{name}'")
    authored = shape.GetPointIndicesAttr().Get()
    offsets = floats(shape.GetOffsetsAttr().Get(), 3)
    # how many normal offsets and offsets of inbetweens a shape has, where it has some
    arrays = [shape.GetNormalOffsetsAttr().Get()]
    for inbetween in shape.GetInbetweens():
        arrays += [inbetween.GetOffsets(), inbetween.GetNormalOffsets()]
    others = [len(array) for array in arrays if array]
    count = len(offsets) or max(others, default=0)
    indices = ints(authored) if authored else np.arange(count, dtype=np.int32)
    if not authored and count not in (0, points):
        raise TopologyError(where, f"{count} offsets without pointIndices, expected {points}")
    if others and not len(offsets):  # UsdSkel moves no point by the shape itself
        offsets = np.zeros((len(indices), 3), np.float32)
    check_inside(where, "pointIndices", indices, points)
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


def _inbetweens(shape: UsdSkel.BlendShape, merge: _Merge) -> tuple[Inbetween, ...]:
    parts = []
    inbetweens = shape.GetInbetweens()
    if len(inbetweens) > MOST_INBETWEENS:
        raise SchemaError(merge.where, f"{len(inbetweens)} inbetweens, expected at most {MOST_INBETWEENS}")
    for inbetween in inbetweens:
        name = inbetween.GetAttr().GetName().removeprefix("inbetweens:")
        weight = inbetween.GetWeight()
        where = f"{merge.where}.inbetweens:{name}"
        # UsdSkel has the neutral at 0 and the shape at 1: another sculpt there would be a second value at one weight
        if weight is None or not np.isfinite(weight) or weight in (0.0, 1.0):
            raise SchemaError(where, f"weight {weight}, expected a number other than 0 and 1")
        normals, offsets = inbetween.GetNormalOffsets(), floats(inbetween.GetOffsets(), 3)
        if normals and not len(offsets):  # it turns normals alone
            offsets = np.zeros((merge.count, 3), np.float32)
        parts.append(
            Inbetween(
                name=name,
                weight=float(weight),
                offsets=merge(f"inbetweens:{name}", offsets),
                normal_offsets=merge.optional(f"inbetweens:{name}:normalOffsets", normals),
            )
        )
    if len({part.weight for part in parts}) != len(parts):
        raise SchemaError(merge.where, "two inbetweens have the same weight")
    return tuple(sorted(parts, key=lambda inbetween: inbetween.weight))


class _Merge:
    """Sorts what is parallel to pointIndices; offsets of a point named twice add up, as UsdSkel applies them."""

    def __init__(self, where: str, count: int, unique: int, place: IntArray) -> None:
        self.where, self.count, self.unique, self.place = where, count, unique, place
        self.sorted = count == unique and bool((place == np.arange(count)).all())

    def __call__(self, field: str, offsets: FloatArray) -> FloatArray:
        if len(offsets) != self.count:
            raise TopologyError(f"{self.where}.{field}", f"{len(offsets)} offsets, expected {self.count}")
        if not np.isfinite(offsets).all():
            raise SchemaError(f"{self.where}.{field}", "NaN or infinity, expected finite numbers")
        if self.sorted:
            return offsets
        merged = np.zeros((self.unique, 3), dtype=np.float32)
        np.add.at(merged, self.place, offsets)
        return merged

    def optional(self, what: str, value: Any) -> FloatArray | None:
        return self(what, floats(value, 3)) if value else None


def author_blendshapes(prim: Usd.Prim, shapes: Sequence[Blendshape], names: Sequence[str]) -> None:
    """Define blendshapes as prims called `names` below a Mesh prim that is bound to a skeleton."""
    _bind(prim, shapes, [_define(prim, shape, name) for shape, name in zip(shapes, names, strict=True)])


def author_blendshape_changes(
    prim: Usd.Prim, old: Sequence[Blendshape], new: Sequence[Blendshape], shared: Collection[Sdf.Path]
) -> tuple[str, ...]:
    """Author on a Mesh prim what of its blendshapes differs; one line per shape.

    Prims of shapes that are gone are deactivated. A shape gets a new prim in place of its own where others use that
    one too, and where it has an inbetween to lose.

    :param prim: bound to a skeleton
    :param old: the blendshapes as read from `prim`
    :param shared: paths of BlendShape prims that are the target of more than one shape
    """
    if same(tuple(old), tuple(new)):
        return ()
    prim = editable(prim, below=True)
    api = UsdSkel.BindingAPI(prim)
    before = list(api.GetBlendShapeTargetsRel().GetTargets())
    paths = dict(zip((str(token) for token in api.GetBlendShapesAttr().Get() or ()), before, strict=False))
    present = {shape.name: shape for shape in old}
    targets, lines = [], []
    for shape in new:
        path, lines_of_shape = _author_change(prim, shape, present.get(shape.name), paths.get(shape.name), shared)
        targets.append(path)
        lines += lines_of_shape
    names = {shape.name for shape in new}
    lines += [f"{shape.name}: removed" for shape in old if shape.name not in names]
    for path in before:
        # a shared prim is still the target of a shape elsewhere
        if path not in targets and path not in shared:
            editable(prim.GetStage().GetPrimAtPath(path)).SetActive(False)
    if targets != before or [shape.name for shape in new] != [shape.name for shape in old]:
        _bind(prim, new, targets)
    return tuple(lines or ["blendshapes: order"])


def _author_change(
    prim: Usd.Prim, shape: Blendshape, present: Blendshape | None, path: Sdf.Path | None, shared: Collection[Sdf.Path]
) -> tuple[Sdf.Path, list[str]]:
    """The target of the shape, and a line where it was authored."""
    known = None if path is None else present
    if known is not None and path is not None and same(shape, known):
        return path, []
    lost = {inbetween.name for inbetween in known.inbetweens} if known else set()
    lost -= {inbetween.name for inbetween in shape.inbetweens}
    # UsdSkel still applies an inbetween whose value is blocked
    if known is None or path is None or lost or path in shared:
        taken = [str(child.GetName()) for child in prim.GetAllChildren()]
        target = _define(prim, shape, unique_identifiers([*taken, shape.name])[-1])
        return target, [f"{shape.name}: {'added' if known is None else 'replaced'}"]
    target = UsdSkel.BlendShape(editable(prim.GetStage().GetPrimAtPath(path)))
    authored = ints(target.GetPointIndicesAttr().Get())
    dense = not authored.size and same(known.point_indices, np.arange(len(known.offsets), dtype=np.int32))
    as_read = dense or same(authored, known.point_indices)  # else sorted or merged by the reader
    fields = _author(target, shape, known if as_read else None)
    return path, [f"{shape.name}: {', '.join(fields)}"] if fields else []


def _define(prim: Usd.Prim, shape: Blendshape, name: str) -> Sdf.Path:
    target = UsdSkel.BlendShape.Define(prim.GetStage(), prim.GetPath().AppendChild(name))
    _author(target, shape)
    author_name(target.GetPrim(), shape)
    return target.GetPath()


def _bind(prim: Usd.Prim, shapes: Sequence[Blendshape], targets: Sequence[Sdf.Path]) -> None:
    binding = UsdSkel.BindingAPI(prim)
    binding.CreateBlendShapesAttr([shape.name for shape in shapes])
    binding.CreateBlendShapeTargetsRel().SetTargets(list(targets))


def _author(target: UsdSkel.BlendShape, shape: Blendshape, present: Blendshape | None = None) -> list[str]:
    """Write what differs from `present`, or all; the fields written."""
    if present is not None and not same(shape.point_indices, present.point_indices):
        present = None  # everything else is parallel to it
    written = []
    if present is None:
        target.CreatePointIndicesAttr(to_ints(shape.point_indices))
        written.append("pointIndices")
    if present is None or not same(shape.offsets, present.offsets):
        target.CreateOffsetsAttr(to_vec3f(shape.offsets))
        written.append("offsets")
    if present is None or not same(_some(shape.normal_offsets), present.normal_offsets):
        _put_normals(target.CreateNormalOffsetsAttr, target.GetNormalOffsetsAttr(), shape.normal_offsets)
        written.append("normalOffsets")
    known = {inbetween.name: inbetween for inbetween in present.inbetweens} if present else {}
    # names for the attributes: as the target has them, or identifiers that it has not
    there = [inbetween.GetAttr().GetName().removeprefix("inbetweens:") for inbetween in target.GetInbetweens()]
    fresh = [inbetween.name for inbetween in shape.inbetweens if inbetween.name not in there]
    names = iter(unique_identifiers([*there, *fresh])[len(there) :])
    for new in shape.inbetweens:
        name, before = new.name if new.name in there else next(names), known.get(new.name)
        if same(new, before):
            continue
        inbetween = target.CreateInbetween(name)
        if before is None or not same(float(new.weight), before.weight):
            inbetween.SetWeight(float(new.weight))
        if before is None or not same(new.offsets, before.offsets):
            inbetween.SetOffsets(to_vec3f(new.offsets))
        if before is None or not same(_some(new.normal_offsets), before.normal_offsets):
            _put_normals(inbetween.CreateNormalOffsetsAttr, inbetween.GetNormalOffsetsAttr(), new.normal_offsets)
        written.append(f"inbetween {new.name}")
    return written


def _put_normals(
    create: Callable[[Vt.Vec3fArray], Usd.Attribute], present: Usd.Attribute, offsets: FloatArray | None
) -> None:
    if offsets is None:
        put(present, None)
    else:
        create(to_vec3f(offsets))


def _some(offsets: FloatArray | None) -> FloatArray | None:
    """None for no offsets, as they are read."""
    return offsets if offsets is not None and len(offsets) else None
