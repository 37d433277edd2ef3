"""Blendshapes authored from parts, and changes of those that a mesh has."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from pxr import Sdf, Usd, UsdSkel, Vt

from facepipe.core.arrays import FloatArray
from facepipe.core.names import unique_identifiers
from facepipe.parts import Blendshape, Inbetween
from facepipe.stage.api_schemas import put
from facepipe.stage.differences import same
from facepipe.stage.display_names import author_name
from facepipe.stage.opinions import editable
from facepipe.stage.values import ints, to_ints, to_vec3f


def author_blendshapes(prim: Usd.Prim, shapes: Sequence[Blendshape], names: Sequence[str]) -> None:
    """Define blendshapes as prims called `names` below a Mesh prim that is bound to a skeleton."""
    _bind(prim, shapes, [_define(prim, shape, name) for shape, name in zip(shapes, names, strict=True)])


def author_blendshape_changes(
    prim: Usd.Prim, old: Sequence[Blendshape], new: Sequence[Blendshape], shared: Collection[Sdf.Path]
) -> tuple[str, ...]:
    """Author on a Mesh prim what of its blendshapes differs; one line per shape.

    Prims of shapes that are gone are deactivated. A shape gets a new prim in place of its own where others use that
    one too, and where it has an inbetween to lose: UsdSkel still applies an inbetween whose value is blocked.

    :param prim: bound to a skeleton
    :param old: the blendshapes as read from `prim`
    :param shared: paths of BlendShape prims that are the target of more than one shape
    """
    if same(tuple(old), tuple(new)):
        return ()
    prim = editable(prim, below=True)
    api = UsdSkel.BindingAPI(prim)
    before = list(api.GetBlendShapeTargetsRel().GetTargets())
    own = dict(zip((str(one) for one in api.GetBlendShapesAttr().Get() or ()), before, strict=False))
    present = {shape.name: shape for shape in old}
    targets, lines = [], []
    for shape in new:
        path, lines_of_shape = _author_change(prim, shape, present.get(shape.name), own.get(shape.name), shared)
        targets.append(path)
        lines += lines_of_shape
    names = {shape.name for shape in new}
    lines += [f"{shape.name}: removed" for shape in old if shape.name not in names]
    for path in before:
        if path not in targets and path not in shared:
            editable(prim.GetStage().GetPrimAtPath(path)).SetActive(False)
    if targets != before or [shape.name for shape in new] != [shape.name for shape in old]:
        _bind(prim, new, targets)
    return tuple(lines or ["blendshapes: order"])


def _author_change(
    prim: Usd.Prim, shape: Blendshape, present: Blendshape | None, path: Sdf.Path | None, shared: Collection[Sdf.Path]
) -> tuple[Sdf.Path, list[str]]:
    """The target of the shape, and a line where it was authored."""
    if present is None or path is None:
        return _define(prim, shape, _free_name(prim, shape.name)), [f"{shape.name}: added"]
    if same(shape, present):
        return path, []
    lost = {one.name for one in present.inbetweens} - {one.name for one in shape.inbetweens}
    if lost or path in shared:
        return _define(prim, shape, _free_name(prim, shape.name)), [f"{shape.name}: replaced"]
    target = UsdSkel.BlendShape(editable(prim.GetStage().GetPrimAtPath(path)))
    authored = ints(target.GetPointIndicesAttr().Get())
    dense = not authored.size and same(present.point_indices, np.arange(len(present.offsets), dtype=np.int32))
    as_read = dense or same(authored, present.point_indices)  # else sorted or merged by the reader
    fields = _author(target, shape, present if as_read else None)
    return path, [f"{shape.name}: {', '.join(fields)}"] if fields else []


def _free_name(prim: Usd.Prim, name: str) -> str:
    return unique_identifiers([*(str(child.GetName()) for child in prim.GetAllChildren()), name])[-1]


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
    known = {one.name: one for one in present.inbetweens} if present else {}
    for name, inbetween in zip(_inbetween_names(target, shape), shape.inbetweens, strict=True):
        if not same(inbetween, known.get(inbetween.name)):
            _author_inbetween(target, name, inbetween, known.get(inbetween.name))
            written.append(f"inbetween {inbetween.name}")
    return written


def _inbetween_names(target: UsdSkel.BlendShape, shape: Blendshape) -> list[str]:
    """Names for the attributes: as the target has them, or identifiers that it has not."""
    there = [one.GetAttr().GetName().removeprefix("inbetweens:") for one in target.GetInbetweens()]
    fresh = [one.name for one in shape.inbetweens if one.name not in there]
    names = iter(unique_identifiers([*there, *fresh])[len(there) :])
    return [one.name if one.name in there else next(names) for one in shape.inbetweens]


def _author_inbetween(target: UsdSkel.BlendShape, name: str, one: Inbetween, present: Inbetween | None) -> None:
    inbetween = target.CreateInbetween(name)
    if present is None or not same(float(one.weight), present.weight):
        inbetween.SetWeight(float(one.weight))
    if present is None or not same(one.offsets, present.offsets):
        inbetween.SetOffsets(to_vec3f(one.offsets))
    if present is None or not same(_some(one.normal_offsets), present.normal_offsets):
        _put_normals(inbetween.CreateNormalOffsetsAttr, inbetween.GetNormalOffsetsAttr(), one.normal_offsets)


def _put_normals(
    create: Callable[[Vt.Vec3fArray], Usd.Attribute], there: Usd.Attribute, offsets: FloatArray | None
) -> None:
    if offsets is None:
        put(there, None)
    else:
        create(to_vec3f(offsets))


def _some(offsets: FloatArray | None) -> FloatArray | None:
    """None for no offsets, as they are read."""
    return offsets if offsets is not None and len(offsets) else None
