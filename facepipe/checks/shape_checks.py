"""Checks of blendshapes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdSkel

from facepipe.checks.views import FaceView, MeshView, Problem, at, numbers, outside, some
from facepipe.core.arrays import FloatArray
from facepipe.stage.blendshapes import MOST_INBETWEENS


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


def names(face: FaceView) -> Iterator[Problem]:
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
        wrong = None if indices is None else outside(indices, mesh.count)
        if wrong:
            yield at(shape.GetPointIndicesAttr(), wrong)


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
            values = numbers(attribute, 3)
            count = 0 if values is None else len(values)
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
