"""Checks of what belongs to points and faces of a mesh: topology, primvars, regions, subsets, landmarks, anchor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import Sdf, UsdGeom

from facepipe.checks.views import FaceView, MeshView, Problem, array, at, length, numbers, outside, value, words
from facepipe.core import tokens
from facepipe.core.arrays import FloatArray

REGION_SUM_TOLERANCE = 1e-3


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
