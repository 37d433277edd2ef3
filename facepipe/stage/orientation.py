"""Which way round faces are wound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pxr import UsdGeom

from facepipe.parts import Mesh


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
