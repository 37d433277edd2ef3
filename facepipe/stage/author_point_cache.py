"""Controls over time, and the points that they moved, as a stage of their own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from facepipe.core.arrays import FloatArray
from facepipe.parts import Mesh
from facepipe.rig.neural_rig import Control
from facepipe.stage.author_controls import author_controls
from facepipe.stage.files import check_suffix, new_stage, save_layer
from facepipe.stage.values import to_ints, to_vec3f

_MILLIMETRE = 0.001


def save_point_cache(
    path: str | os.PathLike[str],
    name: str,
    meshes: Sequence[Mesh],
    controls: Sequence[Control],
    values: FloatArray,
    points: FloatArray,
    rest: FloatArray,
    codes: FloatArray,
    codes_per_second: float,
) -> None:
    """Meshes whose points have time samples, below a prim with numbers ``facepipe:control:<name>``; atomically.

    :param name: of that prim
    :param meshes: names and faces
    :param values: (f, c)
    :param points: (f, n, 3) of all meshes one after another, millimetres, Y up
    :param rest: (n, 3) authored without time
    :param codes: (f,) ascending time codes
    :raises InputError: NaN, a name that USD can't hold, or a file that can't be written
    """
    check_suffix(Path(path))
    stage = new_stage(_MILLIMETRE, "Y", codes_per_second)
    root = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    author_controls(root, path, controls, values, codes)
    ends = np.cumsum([len(mesh.points) for mesh in meshes])
    for mesh, end in zip(meshes, ends, strict=True):
        own = slice(end - len(mesh.points), end)
        _author_mesh(stage, root.GetPath().AppendChild(mesh.name), mesh, points[:, own], rest[own], codes)
    save_layer(stage.GetRootLayer(), path)


def _author_mesh(
    stage: Usd.Stage, path: Sdf.Path, mesh: Mesh, points: FloatArray, rest: FloatArray, codes: FloatArray
) -> None:
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreateFaceVertexCountsAttr(to_ints(mesh.face_vertex_counts))
    prim.CreateFaceVertexIndicesAttr(to_ints(mesh.face_vertex_indices))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    attribute = prim.CreatePointsAttr(to_vec3f(rest))
    ends = np.concatenate([points.min(axis=1)[:, None], points.max(axis=1)[:, None]], axis=1)
    extent = prim.CreateExtentAttr(to_vec3f(np.stack([rest.min(axis=0), rest.max(axis=0)])))
    for code, frame, bounds in zip(codes.tolist(), points, ends, strict=True):
        attribute.Set(to_vec3f(frame), code)
        extent.Set(to_vec3f(bounds), code)
