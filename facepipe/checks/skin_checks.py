"""Checks of skin weights."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import UsdGeom

from facepipe.checks.views import FaceView, MeshView, Problem, array, at, outside, some, value, words

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
        wrong = None if mesh.joint_indices is None else outside(mesh.joint_indices, len(face.joints_of(mesh)))
        if wrong:
            yield at(f"{mesh.path}.{_INDICES}", wrong)


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
