"""Checks of meshes: faces, primvars, regions, subsets, landmarks, skin and blendshapes; then of skeletons, their limits
and their animations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from pxr import Sdf, UsdGeom, UsdSkel

from facepipe.checks.views import (
    FaceView,
    MeshView,
    Problem,
    SkeletonView,
    array,
    at,
    length,
    numbers,
    outside,
    some,
    times,
    value,
    words,
)
from facepipe.core import tokens
from facepipe.core.arrays import FloatArray
from facepipe.stage.read_mesh import MOST_INBETWEENS

REGION_SUM_TOLERANCE = 1e-3
WEIGHT_SUM_TOLERANCE = 1e-4  # float32 weights of 9 influences round to 1e-6; half-precision ones miss 1 by more

_INDICES, _WEIGHTS = "primvars:skel:jointIndices", "primvars:skel:jointWeights"
_GEOM_BIND = "primvars:skel:geomBindTransform"
_Transforms = tuple[tuple[str, FloatArray | None], ...]


def topology(face: FaceView) -> Iterator[Problem]:
    """Face counts add up to the face-vertex indices, and these are points of the mesh."""
    for mesh in face.meshes:
        counts, indices = numbers(mesh.mesh.GetFaceVertexCountsAttr()), numbers(mesh.mesh.GetFaceVertexIndicesAttr())
        total = 0 if counts is None else counts.sum()
        if total != mesh.corners:
            yield at(mesh.prim, f"{mesh.corners} faceVertexIndices, expected {total:g} as the face counts ask for")
        if counts is not None and len(counts) and counts.min() < 3:
            yield at(mesh.mesh.GetFaceVertexCountsAttr(), f"a face of {counts.min():g} points, expected 3 or more")
        yield from outside(mesh.mesh.GetFaceVertexIndicesAttr(), indices, mesh.count)


def primvar_count(face: FaceView) -> Iterator[Problem]:
    """Primvars have as many values as their interpolation asks for, and indices in range."""
    for mesh in face.meshes:
        for primvar in UsdGeom.PrimvarsAPI(mesh.prim).GetPrimvarsWithAuthoredValues():
            name = str(primvar.GetPrimvarName())
            if name.startswith(("skel:", tokens.REGION_PRIMVAR)):
                continue  # they have checks of their own
            values = value(primvar.GetAttr())
            if not primvar.GetTypeName().isArray or not hasattr(values, "__len__"):
                continue
            indices = array(value(primvar.GetIndicesAttr())) if primvar.IsIndexed() else None
            yield from outside(primvar.GetIndicesAttr(), indices, len(values))
            expected = _expected(mesh, primvar.GetInterpolation())
            have = len(values) if indices is None else len(indices)
            if expected is not None and have != expected * max(primvar.GetElementSize(), 1):
                yield at(primvar.GetAttr(), f"{have} values, expected {expected * max(primvar.GetElementSize(), 1)}")


def normal_count(face: FaceView) -> Iterator[Problem]:
    """Normals have as many values as their interpolation asks for."""
    for mesh in face.meshes:
        normals = numbers(mesh.mesh.GetNormalsAttr(), 3)
        expected = _expected(mesh, mesh.mesh.GetNormalsInterpolation())
        if normals is not None and expected is not None and len(normals) != expected:
            yield at(mesh.mesh.GetNormalsAttr(), f"{len(normals)} normals, expected {expected}")


def _expected(mesh: MeshView, interpolation: str) -> int | None:
    return {
        "constant": None,  # any length for arrays
        "uniform": length(numbers(mesh.mesh.GetFaceVertexCountsAttr())),
        "varying": mesh.count,
        "vertex": mesh.count,
        "faceVarying": mesh.corners,
    }.get(str(interpolation))


def _regions(mesh: MeshView) -> Iterator[tuple[UsdGeom.Primvar, FloatArray]]:
    """Each region with its values; without those that are no numbers."""
    for primvar in UsdGeom.PrimvarsAPI(mesh.prim).GetPrimvarsWithAuthoredValues():
        if str(primvar.GetPrimvarName()).startswith(tokens.REGION_PRIMVAR):
            values = array(value(primvar.GetAttr()))
            if values is not None:
                indices = array(value(primvar.GetIndicesAttr())) if primvar.IsIndexed() else None
                inside = indices is not None and not any(outside("", indices, len(values)))
                yield primvar, values[indices.astype(np.int64)] if inside and indices is not None else values


def region_count(face: FaceView) -> Iterator[Problem]:
    """A region has one value per point, vertex-interpolated."""
    for mesh in face.meshes:
        for primvar, values in _regions(mesh):
            if len(values) != mesh.count:
                yield at(primvar.GetAttr(), f"{len(values)} values, expected {mesh.count}")
            if primvar.GetInterpolation() != UsdGeom.Tokens.vertex:
                yield at(primvar.GetAttr(), f"interpolation {primvar.GetInterpolation()}, expected vertex")


def region_range(face: FaceView) -> Iterator[Problem]:
    """Region values are 0 to 1."""
    for mesh in face.meshes:
        for primvar, values in _regions(mesh):
            wrong = values[(values < -1e-6) | (values > 1 + 1e-6)]
            if len(wrong):
                yield at(primvar.GetAttr(), f"{len(wrong)} values like {wrong[0]:g}, expected 0 to 1")


def region_sum(face: FaceView) -> Iterator[Problem]:
    """The regions of a mesh sum to 1 at every point."""
    for mesh in face.meshes:
        masks = [values for _, values in _regions(mesh)]
        if not masks or not mesh.count or any(len(mask) != mesh.count or not np.isfinite(mask).all() for mask in masks):
            continue
        sums = np.sum(masks, axis=0)
        wrong = np.flatnonzero(np.abs(sums - 1) > REGION_SUM_TOLERANCE)
        if len(wrong):
            worst = wrong[np.argmax(np.abs(sums[wrong] - 1))]
            found = f"regions sum to other than 1 at {len(wrong)} of {len(sums)} points"
            yield at(mesh.prim, f"{found} (point {worst}: {sums[worst]:.6g}), expected 1")


def subset_indices(face: FaceView) -> Iterator[Problem]:
    """GeomSubsets name points or faces of their mesh."""
    for mesh in face.meshes:
        sizes = {"point": mesh.count, "face": length(numbers(mesh.mesh.GetFaceVertexCountsAttr()))}
        for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(mesh.prim)):
            kind, indices = str(value(subset.GetElementTypeAttr())), numbers(subset.GetIndicesAttr())
            if kind in sizes:
                yield from outside(subset.GetIndicesAttr(), indices, sizes[kind])


def landmark_indices(face: FaceView) -> Iterator[Problem]:
    """Landmarks are points of their mesh."""
    for mesh, scheme in _schemes(face):
        attribute = mesh.prim.GetAttribute(f"{tokens.LANDMARKS_PREFIX}{scheme}:indices")
        yield from outside(attribute, numbers(attribute), mesh.count)


def landmark_names(face: FaceView) -> Iterator[Problem]:
    """Landmark names are absent, or one per landmark and distinct."""
    for mesh, scheme in _schemes(face):
        prefix = f"{tokens.LANDMARKS_PREFIX}{scheme}"
        names = words(mesh.prim.GetAttribute(f"{prefix}:names"))
        count = length(numbers(mesh.prim.GetAttribute(f"{prefix}:indices")))
        if names and len(names) != count:
            yield at(f"{mesh.path}.{prefix}:names", f"{len(names)} names, expected {count}")
        elif len(set(names)) != len(names):
            yield at(f"{mesh.path}.{prefix}:names", "a name twice, expected each once")


def _schemes(face: FaceView) -> Iterator[tuple[MeshView, str]]:
    for mesh in face.meshes:
        for authored in mesh.prim.GetAuthoredPropertiesInNamespace(tokens.LANDMARKS_PREFIX.rstrip(":")):
            name = str(authored.GetName())
            if name.endswith(":indices"):
                yield mesh, name.removeprefix(tokens.LANDMARKS_PREFIX).removesuffix(":indices")


def anchor_index(face: FaceView) -> Iterator[Problem]:
    """The anchor is a point of its mesh, or -1 for none."""
    for mesh in face.meshes:
        attribute = mesh.prim.GetAttribute(tokens.ANCHOR)
        found = array([value(attribute)]) if value(attribute) is not None else None
        if found is not None and (found != -1).all():
            yield from outside(Sdf.Path(mesh.path).AppendProperty(tokens.ANCHOR).pathString, found, mesh.count)


def _skinned(face: FaceView) -> Iterator[MeshView]:
    return (mesh for mesh in face.meshes if mesh.is_skinned)


def element_size(face: FaceView) -> Iterator[Problem]:
    """Joint indices and weights have one elementSize and one interpolation."""
    for mesh in _skinned(face):
        indices, weights = mesh.inherited(_INDICES), mesh.inherited(_WEIGHTS)
        if indices is None or weights is None:
            name = _WEIGHTS if weights is None else _INDICES
            yield at(mesh.prim, f"{name} has no value, expected one with the other influences")
            continue
        for getter in ("GetElementSize", "GetInterpolation"):
            of_indices, of_weights = (getattr(UsdGeom.Primvar(one), getter)() for one in (indices, weights))
            if of_indices != of_weights:
                pair = f"joint indices with {getter[3:]} {of_indices}, weights with {of_weights}"
                yield at(mesh.prim, f"{pair}, expected the same")


def influence_count(face: FaceView) -> Iterator[Problem]:
    """Influence arrays hold elementSize values per point, or elementSize values for a rigid mesh."""
    for mesh in _skinned(face):
        for name, values in ((_INDICES, mesh.joint_indices), (_WEIGHTS, mesh.joint_weights)):
            attribute = mesh.inherited(name)
            if attribute is None or values is None:
                continue
            primvar = UsdGeom.Primvar(attribute)
            rigid = primvar.GetInterpolation() == UsdGeom.Tokens.constant
            expected = max(primvar.GetElementSize(), 1) * (1 if rigid else mesh.count)
            if len(values) != expected:
                yield at(f"{mesh.path}.{name}", f"{len(values)} values, expected {expected}")


def joint_indices(face: FaceView) -> Iterator[Problem]:
    """Joint indices are in range of the mesh's joints."""
    for mesh in _skinned(face):
        yield from outside(f"{mesh.path}.{_INDICES}", mesh.joint_indices, len(face.joints_of(mesh)))


def weights_sum(face: FaceView) -> Iterator[Problem]:
    """The weights of every point sum to 1."""
    for mesh in _skinned(face):
        attribute, weights = mesh.inherited(_WEIGHTS), mesh.joint_weights
        width = 1 if attribute is None else max(UsdGeom.Primvar(attribute).GetElementSize(), 1)
        if weights is None or len(weights) % width or not np.isfinite(weights).all():
            continue
        sums = weights.reshape(-1, width).sum(axis=1)
        wrong = np.flatnonzero(np.abs(sums - 1) > WEIGHT_SUM_TOLERANCE)
        if len(wrong):
            worst = wrong[np.argmax(np.abs(sums[wrong] - 1))]
            found = f"{len(wrong)} of {len(sums)} points have weights that sum to other than 1"
            yield at(f"{mesh.path}.{_WEIGHTS}", f"{found} (point {worst}: {sums[worst]:.6g}), expected 1")


def weights_negative(face: FaceView) -> Iterator[Problem]:
    """No weight is below 0."""
    for mesh in _skinned(face):
        weights = mesh.joint_weights
        if weights is not None and (weights < 0).any():
            yield at(f"{mesh.path}.{_WEIGHTS}", f"weight {weights.min():g}, expected 0 or above")


def mesh_joints(face: FaceView) -> Iterator[Problem]:
    """skel:joints of a mesh are joints of its skeleton, each once."""
    for mesh in _skinned(face):
        joints = words(mesh.inherited("skel:joints"))
        bound = [
            skeleton for skeleton in face.skeletons if skeleton.prim.GetPath() == mesh.skeleton_path
        ] or face.skeletons[:1]
        unknown = sorted(set(joints) - set(bound[0].joints)) if bound else []
        if unknown:
            yield at(f"{mesh.path}.skel:joints", f"{some(unknown)}: no joint of the skeleton, expected its joints")
        if len(set(joints)) != len(joints):
            yield at(f"{mesh.path}.skel:joints", "a joint is named twice, expected each once")


def geom_bind_authored(face: FaceView) -> Iterator[Problem]:
    """geomBindTransform is authored: what is not authored means identity, which is seldom what was meant."""
    for mesh in _skinned(face):
        if mesh.inherited(_GEOM_BIND) is None:
            yield at(mesh.prim, "geomBindTransform not authored, expected a matrix")


def geom_bind_invertible(face: FaceView) -> Iterator[Problem]:
    """geomBindTransform is invertible."""
    for mesh in _skinned(face):
        matrix = array(value(mesh.inherited(_GEOM_BIND)), 4, 4)
        if matrix is not None and len(matrix) and np.isfinite(matrix).all() and is_singular(matrix)[0]:
            yield at(f"{mesh.path}.{_GEOM_BIND}", "singular matrix, expected an invertible one")


def is_singular(matrices: np.ndarray) -> np.ndarray:
    """(n,) whether (n, 4, 4) matrices are not invertible in practice; NaN counts as invertible here."""
    linear = np.where(np.isfinite(matrices), matrices, 1.0)[:, :3, :3]
    size = np.linalg.norm(linear, axis=(1, 2))
    scaled = linear / np.where(size == 0, 1.0, size)[:, None, None]
    smallest = np.linalg.svd(scaled, compute_uv=False)[:, -1] if len(matrices) else np.zeros(0)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    return np.asarray(finite & ((smallest < 1e-12) | (size == 0)))


def target_count(face: FaceView) -> Iterator[Problem]:
    """skel:blendShapes and skel:blendShapeTargets pair."""
    for mesh in face.meshes:
        names, found = len(mesh.shape_names), len(mesh.shape_targets)
        if names != found:
            yield at(mesh.prim, f"{names} skel:blendShapes and {found} skel:blendShapeTargets, expected as many")


def target_dangling(face: FaceView) -> Iterator[Problem]:
    """Every blendshape target is a BlendShape prim."""
    for mesh in face.meshes:
        for target in mesh.shape_targets:
            prim = face.stage.GetPrimAtPath(target) if target.IsPrimPath() else None
            if not prim or not prim.IsA(UsdSkel.BlendShape):
                found = "nothing" if not prim else f"a prim of type '{prim.GetTypeName()}'"
                yield at(f"{mesh.path}.skel:blendShapeTargets", f"{found} at <{target}>, expected a BlendShape")


def shape_names(face: FaceView) -> Iterator[Problem]:
    """Blendshape names of a mesh are distinct."""
    for mesh in face.meshes:
        twice = sorted(name for name, count in Counter(mesh.shape_names).items() if count > 1)
        if twice:
            yield at(f"{mesh.path}.skel:blendShapes", f"{some(twice)} twice, expected each name once")


def _shapes(face: FaceView) -> Iterator[tuple[MeshView, UsdSkel.BlendShape, FloatArray | None]]:
    """Each blendshape with its mesh and its pointIndices, None where it has none."""
    for mesh in face.meshes:
        for shape in mesh.shapes:
            indices = numbers(shape.GetPointIndicesAttr())
            yield mesh, shape, None if indices is None or not len(indices) else indices


def point_indices(face: FaceView) -> Iterator[Problem]:
    """pointIndices are points of the mesh."""
    for mesh, shape, indices in _shapes(face):
        yield from outside(shape.GetPointIndicesAttr(), indices, mesh.count)


def point_indices_twice(face: FaceView) -> Iterator[Problem]:
    """pointIndices are distinct."""
    for _, shape, indices in _shapes(face):
        if indices is not None:
            unique, count = np.unique(indices, return_counts=True)
            if (count > 1).any():
                twice = some(f"{one:g}" for one in unique[count > 1])
                yield at(shape.GetPointIndicesAttr(), f"point {twice} named twice, expected each point once")


def point_indices_sorted(face: FaceView) -> Iterator[Problem]:
    """pointIndices ascend."""
    for _, shape, indices in _shapes(face):
        if indices is not None and (np.diff(indices) < 0).any():
            yield at(shape.GetPointIndicesAttr(), "not sorted, expected ascending point indices")


def offset_count(face: FaceView) -> Iterator[Problem]:
    """Offsets, normal offsets and inbetweens are parallel to pointIndices, or to the points where there are none."""
    for mesh, shape, indices in _shapes(face):
        expected = mesh.count if indices is None else len(indices)
        # with whether they must be there
        attributes = [(shape.GetOffsetsAttr(), True), (shape.GetNormalOffsetsAttr(), False)]
        for inbetween in shape.GetInbetweens():
            attributes.append((inbetween.GetAttr(), True))
            if inbetween.GetNormalOffsetsAttr():
                attributes.append((inbetween.GetNormalOffsetsAttr(), False))
        for attribute, required in attributes:
            count = length(numbers(attribute, 3))
            empty = indices is None and count == 0  # a shape that moves nothing
            if count != expected and not empty and (required or count):
                yield at(attribute, f"{count} offsets, expected {expected}")


def inbetween_weight(face: FaceView) -> Iterator[Problem]:
    """Inbetweens, not too many, have distinct finite weights other than 0 (the neutral) and 1 (the shape)."""
    for _, shape, _ in _shapes(face):
        weights = set()
        inbetweens = shape.GetInbetweens()
        if len(inbetweens) > MOST_INBETWEENS:
            yield at(shape.GetPrim(), f"{len(inbetweens)} inbetweens, expected at most {MOST_INBETWEENS}")
        for inbetween in inbetweens:
            weight = inbetween.GetWeight()
            if weight is None or not np.isfinite(weight) or weight in (0.0, 1.0):
                found = "no weight" if weight is None else f"weight {weight:g}"
                yield at(inbetween.GetAttr(), f"{found}, expected a number other than 0 and 1")
            elif weight in weights:
                yield at(inbetween.GetAttr(), f"weight {weight:g} of another inbetween, expected its own")
            weights.add(weight)


def _transforms(skeleton: SkeletonView) -> _Transforms:
    return (("bindTransforms", skeleton.bind), ("restTransforms", skeleton.rest))


def transform_count(face: FaceView) -> Iterator[Problem]:
    """As many bind and rest transforms as joints."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if length(matrices) != len(skeleton.joints):
                found = f"{length(matrices)} transforms"
                yield at(f"{skeleton.path}.{name}", f"{found}, expected {len(skeleton.joints)}")


def joint_order(face: FaceView) -> Iterator[Problem]:
    """Joints stand parent first."""
    for skeleton in face.skeletons:
        place = {joint: i for i, joint in reversed(list(enumerate(skeleton.joints)))}
        late = []
        for i, joint in enumerate(skeleton.joints):
            above = joint.rpartition("/")[0]
            while above and place.get(above, -1) <= i:
                above = above.rpartition("/")[0]
            late += [joint] if above else []
        if late:
            yield at(f"{skeleton.path}.joints", f"{some(late)} before a parent, expected parents first")


def joint_names(face: FaceView) -> Iterator[Problem]:
    """Joint names are valid paths, each once."""
    for skeleton in face.skeletons:
        twice = sorted(joint for joint, count in Counter(skeleton.joints).items() if count > 1)
        if twice:
            yield at(f"{skeleton.path}.joints", f"{some(twice)} twice, expected each joint once")
        wrong = [
            joint
            for joint in skeleton.joints
            if not (
                bool(joint) and all(Sdf.Path.IsValidIdentifier(name) for name in joint.removeprefix("/").split("/"))
            )
        ]
        if wrong:
            yield at(f"{skeleton.path}.joints", f"{some(map(repr, wrong))}: no path, expected names joined by /")


def transforms_invertible(face: FaceView) -> Iterator[Problem]:
    """Bind transforms are invertible."""
    for skeleton in face.skeletons:
        singular = [] if skeleton.bind is None else np.flatnonzero(is_singular(skeleton.bind)).tolist()
        if singular:
            names = some(_name(skeleton.joints, i) for i in singular)
            yield at(f"{skeleton.path}.bindTransforms", f"singular matrix of {names}, expected invertible ones")


def transforms_affine(face: FaceView) -> Iterator[Problem]:
    """The last column of bind and rest transforms (USD rows) is 0 0 0 1: no projection."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if matrices is None or not np.isfinite(matrices).all():
                continue
            wrong = np.flatnonzero(np.abs(matrices[:, :, 3] - (0, 0, 0, 1)).max(axis=1, initial=0) > 1e-6)
            if len(wrong):
                names = some(_name(skeleton.joints, i) for i in wrong.tolist())
                yield at(f"{skeleton.path}.{name}", f"no affine matrix for {names}, expected a last column 0 0 0 1")


def joint_scale(face: FaceView) -> Iterator[Problem]:
    """No joint is mirrored or scaled by a negative factor, at bind, at rest or in an animation."""
    for skeleton in face.skeletons:
        for name, matrices in _transforms(skeleton):
            if matrices is not None and np.isfinite(matrices).all():
                mirrored = np.flatnonzero(np.linalg.det(matrices[:, :3, :3]) < 0)
                if len(mirrored):
                    names = some(_name(skeleton.joints, i) for i in mirrored.tolist())
                    yield at(f"{skeleton.path}.{name}", f"mirrored matrix of {names}, expected positive scales")
    for animation in face.animations:
        joints, scales = words(animation.GetJointsAttr()), animation.GetScalesAttr()
        for time in times([scales]):
            values = array(value(scales, time), 3)
            if values is not None and (values < 0).any():
                names = some(_name(joints, i) for i in np.flatnonzero((values < 0).any(axis=1)).tolist())
                yield at(scales, f"negative scale of {names}, expected positive scales")
                break


def _name(joints: tuple[str, ...], i: int) -> str:
    return f"'{joints[i]}'" if i < len(joints) else f"number {i}"


def limits(face: FaceView) -> Iterator[Problem]:
    """Bone limits are 9 per joint, the lower at most the upper."""
    for skeleton in face.skeletons:
        lower, upper = (numbers(skeleton.prim.GetAttribute(n)) for n in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER))
        expected = 9 * len(skeleton.joints)
        counts = {tokens.LIMITS_LOWER: length(lower), tokens.LIMITS_UPPER: length(upper)}
        if set(counts.values()) in ({0}, {expected}):
            if lower is not None and upper is not None and (lower > upper).any():
                worst = int(np.argmax(lower > upper))
                found = f"value {worst}: lower limit {lower[worst]:g} above upper {upper[worst]:g}"
                yield at(f"{skeleton.path}.{tokens.LIMITS_LOWER}", f"{found}, expected at most that")
            continue
        for name, count in counts.items():
            if count != expected:
                yield at(f"{skeleton.path}.{name}", f"{count} values, expected {expected}")


def animation_count(face: FaceView) -> Iterator[Problem]:
    """Arrays of an animation have one entry per joint or blendshape of it, at every time."""
    for animation in face.animations:
        joints, shapes = len(words(animation.GetJointsAttr())), len(words(animation.GetBlendShapesAttr()))
        for attribute, width, expected in (
            (animation.GetTranslationsAttr(), 3, joints),
            (animation.GetRotationsAttr(), 4, joints),
            (animation.GetScalesAttr(), 3, joints),
            (animation.GetPrim().GetAttribute(tokens.BONE_COEFFICIENTS), 1, 9 * joints),
            (animation.GetBlendShapeWeightsAttr(), 1, shapes),
        ):
            if not attribute or not attribute.HasAuthoredValue():
                continue
            for time in times([attribute]):
                values = array(value(attribute, time), width)
                if values is not None and len(values) != expected:
                    when = "" if time.IsDefault() else f" at time {time.GetValue():g}"
                    yield at(attribute, f"{len(values)} values{when}, expected {expected}")
                    break


def animation_transforms(face: FaceView) -> Iterator[Problem]:
    """An animation with joints authors translations, rotations and scales: UsdSkel takes no joint pose without all."""
    for animation in face.animations:
        if not words(animation.GetJointsAttr()):
            continue
        for name in ("translations", "rotations", "scales"):
            attribute = animation.GetPrim().GetAttribute(name)
            if not attribute or not attribute.HasAuthoredValue():
                yield at(animation.GetPrim(), f"{name} not authored, expected one per joint")


def animation_names(face: FaceView) -> Iterator[Problem]:
    """Animations move joints and blendshapes that the face has, each once."""
    for animation in face.animations:
        for attribute, known, kind in (
            (animation.GetJointsAttr(), set(face.joints), "joint of the skeleton"),
            (animation.GetBlendShapesAttr(), face.shape_names, "blendshape of a mesh"),
        ):
            names = words(attribute)
            unknown = sorted(set(names) - known)
            if unknown:
                yield at(attribute, f"{some(unknown)}: no {kind}, expected one")
            if len(set(names)) != len(names):
                yield at(attribute, "a name twice, expected each once")


def rotations_unit(face: FaceView) -> Iterator[Problem]:
    """Rotations of animations are unit quaternions."""
    for animation in face.animations:
        attribute = animation.GetRotationsAttr()
        for time in times([attribute]):
            values = array(value(attribute, time), 4)
            sizes = np.linalg.norm(values, axis=1) if values is not None and np.isfinite(values).all() else np.ones(1)
            if (np.abs(sizes - 1) > 1e-3).any():
                worst = float(sizes[np.argmax(np.abs(sizes - 1))])
                yield at(attribute, f"quaternion of length {worst:g}, expected 1")
                break
