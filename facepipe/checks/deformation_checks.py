"""Checks of what moves points: skin weights and blendshapes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.checks.views import FaceView, MeshView, Problem, array, at, length, numbers, outside, some, value, words
from facepipe.core.arrays import FloatArray
from facepipe.stage.blendshapes import MOST_INBETWEENS

WEIGHT_SUM_TOLERANCE = 1e-4  # float32 weights of 9 influences round to 1e-6; half-precision ones miss 1 by more

_INDICES, _WEIGHTS = "primvars:skel:jointIndices", "primvars:skel:jointWeights"
_GEOM_BIND = "primvars:skel:geomBindTransform"


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
        weights = mesh.weights_by_point
        if weights is None or not np.isfinite(weights).all():
            continue
        sums = weights.sum(axis=1)
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
        for attribute, required in _offsets(shape):
            count = length(numbers(attribute, 3))
            empty = indices is None and count == 0  # a shape that moves nothing
            if count != expected and not empty and (required or count):
                yield at(attribute, f"{count} offsets, expected {expected}")


def _offsets(shape: UsdSkel.BlendShape) -> Iterator[tuple[Usd.Attribute, bool]]:
    """Offset attributes, and whether they must be there."""
    yield shape.GetOffsetsAttr(), True
    yield shape.GetNormalOffsetsAttr(), False
    for inbetween in shape.GetInbetweens():
        yield inbetween.GetAttr(), True
        if inbetween.GetNormalOffsetsAttr():
            yield inbetween.GetNormalOffsetsAttr(), False


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
