"""Meshes of a stage as parts, with their blendshapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import SchemaError, TopologyError
from facepipe.parts import Blendshape, Inbetween, Landmarks, MaterialFaces, Mesh, Skin, UvSet
from facepipe.stage.prims import data_label, label
from facepipe.stage.values import check_inside, floats, ints, matrix, reads_prim

MOST_INBETWEENS = 100  # of a shape: each is a curve through the weights of all
UV_TYPES = ("texCoord2f[]", "float2[]", "texCoord2h[]", "texCoord2d[]")
_FLOAT_ARRAYS = (Sdf.ValueTypeNames.FloatArray, Sdf.ValueTypeNames.DoubleArray, Sdf.ValueTypeNames.HalfArray)


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
        _read_shape(UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(target)), str(target), name, points)
        for name, target in zip(names, targets, strict=True)
    )


def _read_shape(shape: UsdSkel.BlendShape, where: str, name: str, points: int) -> Blendshape:
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
    merge = _Merge(where, indices)
    return Blendshape(
        name=name,
        point_indices=merge.unique.astype(np.int32),
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

    def __init__(self, where: str, indices: IntArray) -> None:
        self.where, self.count, self.unique, self.place = where, len(indices), indices, indices
        self.sorted = bool((indices[1:] > indices[:-1]).all())  # as most are, which saves a sort
        if not self.sorted:
            self.unique, self.place = np.unique(indices, return_inverse=True)

    def __call__(self, field: str, offsets: FloatArray) -> FloatArray:
        if len(offsets) != self.count:
            raise TopologyError(f"{self.where}.{field}", f"{len(offsets)} offsets, expected {self.count}")
        if not np.isfinite(offsets).all():
            raise SchemaError(f"{self.where}.{field}", "NaN or infinity, expected finite numbers")
        if self.sorted:
            return offsets
        merged = np.zeros((len(self.unique), 3), dtype=np.float32)
        np.add.at(merged, self.place, offsets)
        return merged

    def optional(self, what: str, value: Any) -> FloatArray | None:
        return self(what, floats(value, 3)) if value else None


class Binding(NamedTuple):
    """What UsdSkel says of a bound mesh: its skinning query, and the joints of its skeleton."""

    query: UsdSkel.SkinningQuery
    joints: tuple[str, ...]


@reads_prim
def read_mesh(
    prim: Usd.Prim,
    name: str,
    binding: Binding | None,
    material_names: Mapping[str, str],
    *,
    unbound_shapes: bool = False,
) -> Mesh:
    """One mesh, its faces wound counter-clockwise as seen from outside whatever the orientation of the prim.

    :param material_names: name of a material by its prim path
    :param unbound_shapes: read blendshapes of meshes without Skeleton too, which UsdSkel ignores
    :raises SchemaError, TopologyError: attributes that don't fit the mesh
    """
    mesh = UsdGeom.Mesh(prim)
    points = floats(mesh.GetPointsAttr().Get(), 3)
    counts, indices = ints(mesh.GetFaceVertexCountsAttr().Get()), ints(mesh.GetFaceVertexIndicesAttr().Get())
    where = str(prim.GetPath())
    # the sum is not enough: counts of 5 and -1 fit four corners
    if (counts.size and (counts.min() < 0 or counts.sum() != len(indices))) or (not counts.size and indices.size):
        raise TopologyError(where, f"face counts ask for {counts.sum()} corners, got {len(indices)}")
    check_inside(where, "faceVertexIndices", indices, len(points))
    if not np.isfinite(points).all():
        raise SchemaError(where, "points hold NaN or infinity, expected finite numbers")
    whole, by_face = _materials(prim, material_names)
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")  # wins over the attribute, as USD says
    authored = primvar and primvar.HasAuthoredValue()
    normals = floats(primvar.ComputeFlattened() if authored else mesh.GetNormalsAttr().Get(), 3)
    fitting = len(normals) and len(normals) in (len(points), len(indices)) and np.isfinite(normals).all()
    primvar = UsdGeom.Gprim(prim).GetDisplayColorPrimvar()
    colors = floats(primvar.ComputeFlattened() if primvar and primvar.HasAuthoredValue() else None, 3)
    shown = len(colors) == 1 or len(colors) == len(points) > 0  # one colour is that of all points
    anchor = prim.GetAttribute(tokens.ANCHOR).Get()
    result = Mesh(
        name=name,
        points=points,
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        transform=matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())),
        normals=normals if fitting else None,
        uv_sets=_uv_sets(prim, len(points), len(indices)),
        colors=np.repeat(colors, len(points) // len(colors), axis=0) if shown else None,
        skin=_skin(where, len(points), binding) if binding else None,
        blendshapes=read_blendshapes(prim, len(points))
        if unbound_shapes or (binding is not None and bool(binding.query.HasBlendShapes()))
        else (),
        regions=_regions(prim, len(points)),
        point_subsets=_point_subsets(prim, len(points)),
        landmarks=_landmarks(prim, len(points)),
        anchor=int(anchor) if anchor is not None and anchor >= 0 else None,
        material=whole,
        material_faces=by_face,
        double_sided=bool(mesh.GetDoubleSidedAttr().Get()),
        label=label(prim, name),
        data_label=data_label(prim),
    )
    return turned(result) if is_left_handed(mesh) else result


@reads_prim
def read_point_values(prim: Usd.Prim, name: str, points: int) -> FloatArray:
    """(n,) values of a float primvar with one value per point; NaN where the mesh has none of that name."""
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar(name)
    values = floats(primvar.ComputeFlattened()) if primvar and primvar.GetTypeName() in _FLOAT_ARRAYS else floats(None)
    return values if len(values) == points else np.full(points, np.nan, dtype=np.float32)


def _uv_sets(prim: Usd.Prim, points: int, corners: int) -> tuple[UvSet, ...]:
    uv_sets = []
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        kind = str(primvar.GetTypeName())
        if kind not in UV_TYPES:
            continue
        values = floats(primvar.Get(), 2)
        per_point = primvar.GetInterpolation() in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying)
        indices = ints(primvar.GetIndices()) if primvar.IsIndexed() else None
        expected = points if per_point else corners
        where = f"{prim.GetPath()}.{primvar.GetAttr().GetName()}"
        if len(values if indices is None else indices) != expected:
            raise TopologyError(where, f"{len(values if indices is None else indices)} values, expected {expected}")
        if indices is not None:
            check_inside(where, "indices", indices, len(values))
        if per_point:
            values, indices = values if indices is None else values[indices], None
        elif indices is None:  # else they stay: corners of a point with different ones are a seam
            indices = np.arange(corners, dtype=np.int32)
        uv_sets.append(UvSet(name=primvar.GetPrimvarName(), values=values, indices=indices))
    return tuple(uv_sets)


def _skin(where: str, points: int, binding: Binding) -> Skin | None:
    query, joints = binding
    if not query.HasJointInfluences() or not joints:
        return None
    width = query.GetNumInfluencesPerComponent()
    indices = ints(query.GetJointIndicesPrimvar().ComputeFlattened())
    weights = floats(query.GetJointWeightsPrimvar().ComputeFlattened())
    if len(indices) != len(weights):
        raise TopologyError(where, f"{len(indices)} joint indices and {len(weights)} joint weights, expected as many")
    indices, weights = indices.reshape(-1, width), weights.reshape(-1, width)
    if query.IsRigidlyDeformed():
        # constant influences move a mesh as a whole, for which parts have no case of its own
        indices, weights = np.repeat(indices[:1], points, axis=0), np.repeat(weights[:1], points, axis=0)
    if len(indices) != points:
        raise TopologyError(where, f"joint influences of {len(indices)} points, expected {points}")
    # indices into the skeleton's joints; those without weight are 0
    order = query.GetJointOrder()
    names = tuple(str(joint) for joint in order) if order else joints
    used = weights != 0
    check_inside(where, "joint indices", indices[used], len(names))
    place = {joint: i for i, joint in enumerate(joints)}
    missing = [joint for joint in names if joint not in place]
    if missing:
        raise SchemaError(f"{where}.skel:joints", f"'{missing[0]}' is not a joint of the skeleton")
    table = np.array([place[joint] for joint in names], dtype=np.int32)
    indices = np.where(used, table[np.where(used, indices, 0)], 0).astype(np.int32)
    return Skin(
        joint_indices=indices,
        joint_weights=weights,
        geom_bind_transform=matrix(query.GetGeomBindTransform(Usd.TimeCode.Default())),
        dual_quaternion=query.GetSkinningMethod() == UsdSkel.Tokens.dualQuaternion,
    )


def _regions(prim: Usd.Prim, points: int) -> dict[str, FloatArray]:
    regions = {}
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        name = str(primvar.GetPrimvarName())
        if name.startswith(tokens.REGION_PRIMVAR):
            values = floats(primvar.ComputeFlattened())
            if len(values) != points:
                raise TopologyError(f"{prim.GetPath()}.primvars:{name}", f"{len(values)} values, expected {points}")
            regions[name.removeprefix(tokens.REGION_PRIMVAR)] = values
    return regions


def _point_subsets(prim: Usd.Prim, points: int) -> dict[str, npt.NDArray[np.int32]]:
    subsets = {}
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.point:
            indices = ints(subset.GetIndicesAttr().Get())
            check_inside(subset.GetPath(), "indices", indices, points)
            subsets[subset.GetPrim().GetName()] = indices
    return subsets


def _landmarks(prim: Usd.Prim, points: int) -> dict[str, Landmarks]:
    schemes = {}
    for attribute in prim.GetPropertiesInNamespace(tokens.LANDMARKS_PREFIX.rstrip(":")):
        name = attribute.GetName()
        if name.endswith(":indices") and attribute.HasAuthoredValue():
            scheme = name.removeprefix(tokens.LANDMARKS_PREFIX).removesuffix(":indices")
            indices = ints(attribute.Get())
            check_inside(f"{prim.GetPath()}.{name}", "indices", indices, points)
            names = prim.GetAttribute(f"{tokens.LANDMARKS_PREFIX}{scheme}:names").Get() or ()
            schemes[scheme] = Landmarks(indices=indices, names=tuple(str(landmark) for landmark in names))
    return schemes


def _materials(prim: Usd.Prim, names: Mapping[str, str]) -> tuple[str | None, tuple[MaterialFaces, ...]]:
    whole = names.get(_bound(prim))
    by_face = []
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            material = names.get(_bound(subset.GetPrim()))
            if material:
                by_face.append(MaterialFaces(material=material, faces=ints(subset.GetIndicesAttr().Get())))
    return whole, tuple(by_face)


def _bound(prim: Usd.Prim) -> str:
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return str(material.GetPath()) if material else ""


def is_left_handed(mesh: UsdGeom.Mesh) -> bool:
    """Whether the faces of a Mesh prim are wound clockwise as seen from outside."""
    return bool(mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded)


def turned(mesh: Mesh) -> Mesh:
    """The mesh with every face wound the other way round; what stands per corner follows."""
    counts = np.asarray(mesh.face_vertex_counts, dtype=np.int64)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    back = 2 * starts + np.repeat(counts, counts) - 1 - np.arange(counts.sum())
    normals = mesh.normals
    if normals is not None and len(normals) != len(mesh.points):
        normals = normals[back]
    return replace(
        mesh,
        face_vertex_indices=mesh.face_vertex_indices[back],
        normals=normals,
        uv_sets=tuple(uv if uv.indices is None else replace(uv, indices=uv.indices[back]) for uv in mesh.uv_sets),
    )
