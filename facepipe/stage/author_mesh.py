"""Meshes and their blendshapes authored from parts, and what of them differs from their prims authored over these."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unique_identifiers
from facepipe.parts import Blendshape, Mesh, Skin
from facepipe.stage.material_variants import Bindings
from facepipe.stage.prims import (
    apply_schema,
    author_data_label,
    author_name,
    check_property_name,
    editable,
    inherited_attribute,
    inherited_skeleton,
    instances,
    put,
    put_value,
    remove_schema,
)
from facepipe.stage.read_mesh import is_left_handed, turned
from facepipe.stage.values import floats, ints, require_same, same, to_floats, to_ints, to_matrix, to_vec2f, to_vec3f

SUBSET_FAMILY = "facepipeRegion"
_INFLUENCES = ("joint_indices", "joint_weights")


def check_region_name(where: object, name: str) -> None:
    """:raises InputError: a name that USD can't hold, or one of the region schema itself"""
    check_property_name(where, "region", name, tokens.REGION_API)


def author_regions(prim: Usd.Prim, mesh: Mesh) -> None:
    """Write the regions of `mesh` on a Mesh prim; those that it has and `mesh` lacks are blocked.

    Masks that are on the prim already are left alone, so that a layer holds only what changed.

    :raises InputError: a name that USD can't hold, or a prim inside an instance
    """
    for name in mesh.regions:
        check_region_name(prim.GetPath(), name)
    _check_writable(prim)
    api = UsdGeom.PrimvarsAPI(prim)
    for name, mask in mesh.regions.items():
        if name not in instances(prim, tokens.REGION_API):
            apply_schema(prim, tokens.REGION_API, name)
        primvar = api.GetPrimvar(tokens.REGION_PRIMVAR + name)
        plain = primvar and primvar.HasAuthoredValue() and not primvar.IsIndexed()
        kind = (primvar.GetTypeName(), primvar.GetInterpolation()) if plain else None
        if kind != (Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex) or not np.array_equal(
            floats(primvar.Get()), np.asarray(mask, dtype=np.float32)
        ):
            author_point_values(prim, tokens.REGION_PRIMVAR + name, mask)
    for primvar in api.GetPrimvarsWithAuthoredValues():
        name = str(primvar.GetPrimvarName())
        if name.startswith(tokens.REGION_PRIMVAR) and name.removeprefix(tokens.REGION_PRIMVAR) not in mesh.regions:
            primvar.GetAttr().Block()  # BlockPrimvar blocks nothing that a weaker layer holds
    for name in instances(prim, tokens.REGION_API):
        if name not in mesh.regions:
            remove_schema(prim, tokens.REGION_API, name)


def author_region_subsets(prim: Usd.Prim, subsets: dict[str, IntArray], removed: tuple[str, ...]) -> None:
    """Write point subsets by name on a Mesh prim, and deactivate those called as in `removed`.

    Subsets that hold the points already are left alone.

    :raises InputError: a prim inside an instance, or a child that is no subset in the way
    """
    _check_writable(prim)
    for name, indices in subsets.items():
        child = prim.GetChild(name)
        if child and not child.IsA(UsdGeom.Subset):
            raise InputError(child.GetPath(), f"is a {child.GetTypeName()}, expected a GeomSubset for the region")
        if child and not child.IsActive():
            child.SetActive(True)  # of a region that was removed before: a layer can't define it once more
        old = UsdGeom.Subset(child).GetIndicesAttr().Get() if child else None
        if old is None or not np.array_equal(ints(old), indices):
            UsdGeom.Subset.CreateGeomSubset(
                UsdGeom.Imageable(prim), name, UsdGeom.Tokens.point, to_ints(indices), SUBSET_FAMILY
            )
    for name in removed:
        child = prim.GetChild(name)
        if child and child.IsA(UsdGeom.Subset):
            child.SetActive(False)


def _check_writable(prim: Usd.Prim) -> None:
    if prim.IsInstanceProxy():
        raise InputError(prim.GetPath(), "lies in an instance, expected a mesh of its own to write regions on")


def author_mesh(
    stage: Usd.Stage,
    path: Sdf.Path,
    mesh: Mesh,
    skeleton: UsdSkel.Skeleton,
    joints: tuple[str, ...],
    bindings: Bindings,
) -> UsdGeom.Mesh:
    """Define one mesh with its shapes, skin, regions and subsets.

    :raises InputError: a name that USD can't hold, or an unknown material
    """
    prim = UsdGeom.Mesh.Define(stage, path)
    author_name(prim.GetPrim(), mesh)
    author_data_label(prim.GetPrim(), mesh)
    prim.CreatePointsAttr(to_vec3f(mesh.points))
    prim.CreateFaceVertexCountsAttr(to_ints(mesh.face_vertex_counts))
    prim.CreateFaceVertexIndicesAttr(to_ints(mesh.face_vertex_indices))
    # USD's default is catmullClark: renderers would smooth the face, and shapes would move other points than ours
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(prim.GetPointsAttr().Get()) or [])
    if mesh.double_sided:
        prim.CreateDoubleSidedAttr(True)
    if not np.array_equal(mesh.transform, np.eye(4)):
        prim.AddTransformOp().Set(to_matrix(mesh.transform))
    if mesh.normals is not None:
        author_normals(prim, mesh.normals)
    _author_uv_sets(prim, mesh)
    if mesh.colors is not None:
        prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(to_vec3f(mesh.colors))
    author_regions(prim.GetPrim(), mesh)
    # names of prims below, all distinct; a subset keeps its own, since the name is all that it has
    subsets, faces = len(mesh.point_subsets), len(mesh.material_faces)
    wanted = (*(f"{part.material}_faces" for part in mesh.material_faces), *(shape.name for shape in mesh.blendshapes))
    names = unique_identifiers([*mesh.point_subsets, *wanted])

    if mesh.material:
        bindings.bind(prim.GetPrim(), mesh.material)
    if mesh.material_faces:
        api = UsdShade.MaterialBindingAPI.Apply(prim.GetPrim())
        for name, part in zip(names[subsets : subsets + faces], mesh.material_faces, strict=True):
            bindings.bind(api.CreateMaterialBindSubset(name, to_ints(part.faces)).GetPrim(), part.material)
        whole = sum(len(part.faces) for part in mesh.material_faces) == len(mesh.face_vertex_counts)
        api.SetMaterialBindSubsetsFamilyType(UsdGeom.Tokens.partition if whole else UsdGeom.Tokens.nonOverlapping)
    if mesh.skin or mesh.blendshapes:
        binding = UsdSkel.BindingAPI.Apply(prim.GetPrim())
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        if mesh.skin and joints:
            author_skin(prim.GetPrim(), mesh.skin, joints)
        if mesh.blendshapes:
            author_blendshapes(prim.GetPrim(), mesh.blendshapes, names[subsets + faces :])
    for name, subset in zip(names[:subsets], mesh.point_subsets.values(), strict=True):
        UsdGeom.Subset.CreateGeomSubset(prim, name, UsdGeom.Tokens.point, to_ints(subset), SUBSET_FAMILY)
    author_landmarks(prim.GetPrim(), mesh)
    return prim


def author_landmarks(prim: Usd.Prim, mesh: Mesh) -> None:
    """Write the landmarks and the anchor of `mesh` on a Mesh prim."""
    for scheme, landmarks in mesh.landmarks.items():
        check_property_name(prim.GetPath(), "landmark scheme", scheme, tokens.LANDMARKS_API)
        apply_schema(prim, tokens.LANDMARKS_API, scheme)
        prefix = f"{tokens.LANDMARKS_PREFIX}{scheme}"
        put_value(prim, f"{prefix}:indices", to_ints(landmarks.indices))
        names = f"{prefix}:names"
        if landmarks.names or prim.GetAttribute(names).HasAuthoredValue():  # those of earlier landmarks must not stay
            put_value(prim, names, list(landmarks.names))
    if mesh.anchor is not None:
        apply_schema(prim, tokens.ANCHOR_API)
        put_value(prim, tokens.ANCHOR, int(mesh.anchor))


def _author_uv_sets(prim: UsdGeom.Mesh, mesh: Mesh) -> None:
    for uv in mesh.uv_sets:
        check_property_name(prim.GetPath(), "UV set", uv.name)
        kind = UsdGeom.Tokens.vertex if uv.indices is None else UsdGeom.Tokens.faceVarying
        primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(uv.name, Sdf.ValueTypeNames.TexCoord2fArray, kind)
        primvar.Set(to_vec2f(uv.values))
        if uv.indices is not None:
            primvar.SetIndices(to_ints(uv.indices))
        elif primvar.IsIndexed():
            primvar.BlockIndices()


def author_normals(prim: UsdGeom.Mesh, normals: FloatArray) -> None:
    """Write (n, 3) normals per point, or (corners, 3) face-varying ones."""
    per_point = len(normals) == len(prim.GetPointsAttr().Get())
    prim.CreateNormalsAttr(to_vec3f(normals))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex if per_point else UsdGeom.Tokens.faceVarying)


def author_skin(prim: Usd.Prim, skin: Skin, joints: Sequence[str], present: Skin | None = None) -> None:
    """Write what of a skin differs from `present`, or all, on a Mesh prim: influences per point, into `joints`."""
    binding, width = UsdSkel.BindingAPI(prim), skin.joint_indices.shape[1]
    if not (present and all(same(getattr(skin, field), getattr(present, field)) for field in _INFLUENCES)):
        indices = binding.CreateJointIndicesPrimvar(False, width)
        weights = binding.CreateJointWeightsPrimvar(False, width)
        indices.Set(to_ints(skin.joint_indices))
        weights.Set(to_floats(skin.joint_weights))
        for primvar in (indices, weights):
            if primvar.IsIndexed():
                primvar.BlockIndices()
        if inherited_attribute(prim, "skel:joints"):  # another order of the joints
            binding.CreateJointsAttr(list(joints))
    if skin.dual_quaternion != (present is not None and present.dual_quaternion):
        method = UsdSkel.Tokens.dualQuaternion if skin.dual_quaternion else UsdSkel.Tokens.classicLinear
        binding.CreateSkinningMethodAttr(method)
    if not (present and same(skin.geom_bind_transform, present.geom_bind_transform)):
        binding.CreateGeomBindTransformAttr(to_matrix(skin.geom_bind_transform))


def author_point_values(prim: Usd.Prim, name: str, values: FloatArray) -> None:
    """Write a float primvar with one value (n,) per point on a Mesh prim."""
    kind = Sdf.ValueTypeNames.FloatArray
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
    primvar.Set(to_floats(values))
    if primvar.IsIndexed():
        primvar.BlockIndices()


_TOPOLOGY = ("face_vertex_counts", "face_vertex_indices")
_FIXED = ("name", "transform", "uv_sets", "colors", "point_subsets", "material", "material_faces", "double_sided")


def check_mesh_change(where: object, old: Mesh, new: Mesh) -> None:
    """Check that only what can be authored over a mesh differs.

    :raises TopologyError: another number of points, or other faces
    :raises InputError: a change of a field that can't be authored over, or a skin that is gone
    """
    if len(new.points) != len(old.points):
        raise TopologyError(where, f"{len(new.points)} points, expected {len(old.points)}")
    if not all(same(getattr(old, field), getattr(new, field)) for field in _TOPOLOGY):
        raise TopologyError(where, "other faces, expected those of the face")
    require_same(where, old, new, _FIXED)
    if old.skin is not None and new.skin is None:
        raise InputError(f"{where} -> skin", "none, expected one as the face has it")


def author_mesh_changes(
    prim: Usd.Prim, old: Mesh, new: Mesh, skeleton: Usd.Prim, joints: tuple[str, ...], shared: Collection[Sdf.Path]
) -> tuple[str, ...]:
    """Author what differs between a mesh as read from its prim and `new`; one line per thing.

    :param skeleton: the Skeleton prim, which the mesh is bound to where it wasn't
    :param shared: paths of BlendShape prims that are the target of more than one shape
    """
    if same(old, new):
        return ()
    prim = editable(prim)
    mesh, lines = UsdGeom.Mesh(prim), []
    if not same(old.points, new.points):
        put(mesh.CreatePointsAttr(), to_vec3f(new.points))
        put(mesh.CreateExtentAttr(), UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()) or [])
        lines.append("points")
    if not same(old.normals, new.normals):
        put(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").GetAttr(), None)  # it would win over the attribute
        if new.normals is None:
            put(mesh.GetNormalsAttr(), None)
        else:
            mesh.GetNormalsAttr().Clear()
            # parts have faces wound counter-clockwise; face-varying normals follow the corners as the prim winds them
            author_normals(mesh, np.asarray((turned(new) if is_left_handed(mesh) else new).normals))
        lines.append("normals")
    if new.blendshapes or (new.skin and joints):
        if not prim.HasAPI(UsdSkel.BindingAPI):
            UsdSkel.BindingAPI.Apply(prim)
        if inherited_skeleton(prim) != skeleton.GetPath():
            UsdSkel.BindingAPI(prim).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    if new.skin is not None and joints and not same(old.skin, new.skin):
        author_skin(prim, new.skin, joints, old.skin)
        lines.append("skin")
    if not same(old.regions, new.regions):
        author_regions(prim, new)
        lines.append("regions")
    changed = {
        name: landmarks for name, landmarks in new.landmarks.items() if not same(landmarks, old.landmarks.get(name))
    }
    removed = [name for name in old.landmarks if name not in new.landmarks]
    anchor = new.anchor if new.anchor != old.anchor else None
    author_landmarks(prim, replace(new, landmarks=changed, anchor=anchor))
    for name in removed:
        for field in ("indices", "names"):
            put_value(prim, f"{tokens.LANDMARKS_PREFIX}{name}:{field}", None)
        remove_schema(prim, tokens.LANDMARKS_API, name)
    if new.anchor is None and old.anchor is not None:
        put_value(prim, tokens.ANCHOR, None)
        remove_schema(prim, tokens.ANCHOR_API)
    lines += [f"landmarks {name}" for name in (*changed, *removed)]
    lines += ["anchor"] if new.anchor != old.anchor else []
    lines += author_blendshape_changes(prim, old.blendshapes, new.blendshapes, shared)
    return tuple(f"{new.name}: {line}" for line in lines)


_KEPT = ("name", "transform", "colors", "point_subsets", "material", "material_faces", "double_sided", "landmarks")


def author_other_mesh(
    prim: Usd.Prim, old: Mesh, new: Mesh, skeleton: Usd.Prim, joints: tuple[str, ...], shared: Collection[Sdf.Path]
) -> None:
    """Author another mesh over one as read from its prim: other points, faces, texture coordinates, skin and shapes.

    As `author_mesh_changes`, which is for meshes of the same points.

    :raises InputError: a difference in a field that stays as it is, or texture coordinates of other names
    """
    where = prim.GetPath()
    require_same(where, old, new, _KEPT)
    if [uv.name for uv in old.uv_sets] != [uv.name for uv in new.uv_sets]:
        raise InputError(f"{where} -> uv_sets", "others, expected texture coordinates of the same names")
    mesh = UsdGeom.Mesh(editable(prim))
    put(mesh.CreateFaceVertexCountsAttr(), to_ints(new.face_vertex_counts))
    put(mesh.CreateFaceVertexIndicesAttr(), to_ints(new.face_vertex_indices))
    _author_uv_sets(mesh, new)
    author_mesh_changes(mesh.GetPrim(), old, new, skeleton, joints, shared)


def author_blendshapes(prim: Usd.Prim, shapes: Sequence[Blendshape], names: Sequence[str]) -> None:
    """Define blendshapes as prims called `names` below a Mesh prim that is bound to a skeleton."""
    _bind_shapes(prim, shapes, [_define_shape(prim, shape, name) for shape, name in zip(shapes, names, strict=True)])


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
        path, lines_of_shape = _author_shape_change(prim, shape, present.get(shape.name), paths.get(shape.name), shared)
        targets.append(path)
        lines += lines_of_shape
    names = {shape.name for shape in new}
    lines += [f"{shape.name}: removed" for shape in old if shape.name not in names]
    for path in before:
        # a shared prim is still the target of a shape elsewhere
        if path not in targets and path not in shared:
            editable(prim.GetStage().GetPrimAtPath(path)).SetActive(False)
    if targets != before or [shape.name for shape in new] != [shape.name for shape in old]:
        _bind_shapes(prim, new, targets)
    return tuple(lines or ["blendshapes: order"])


def _author_shape_change(
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
        target = _define_shape(prim, shape, unique_identifiers([*taken, shape.name])[-1])
        return target, [f"{shape.name}: {'added' if known is None else 'replaced'}"]
    target = UsdSkel.BlendShape(editable(prim.GetStage().GetPrimAtPath(path)))
    authored = ints(target.GetPointIndicesAttr().Get())
    dense = not authored.size and same(known.point_indices, np.arange(len(known.offsets), dtype=np.int32))
    as_read = dense or same(authored, known.point_indices)  # else sorted or merged by the reader
    fields = _author_shape(target, shape, known if as_read else None)
    return path, [f"{shape.name}: {', '.join(fields)}"] if fields else []


def _define_shape(prim: Usd.Prim, shape: Blendshape, name: str) -> Sdf.Path:
    target = UsdSkel.BlendShape.Define(prim.GetStage(), prim.GetPath().AppendChild(name))
    _author_shape(target, shape)
    author_name(target.GetPrim(), shape)
    return target.GetPath()


def _bind_shapes(prim: Usd.Prim, shapes: Sequence[Blendshape], targets: Sequence[Sdf.Path]) -> None:
    binding = UsdSkel.BindingAPI(prim)
    binding.CreateBlendShapesAttr([shape.name for shape in shapes])
    binding.CreateBlendShapeTargetsRel().SetTargets(list(targets))


def _author_shape(target: UsdSkel.BlendShape, shape: Blendshape, present: Blendshape | None = None) -> list[str]:
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
