"""A mesh in glTF space: points, normals, corners and morph offsets, not yet split into primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.parts import FaceParts, FloatArray, Mesh
from facepipe_gltf.encoding import Encoding, Grid, decode, grid_around
from facepipe_gltf.influences import Influences, limit
from facepipe_gltf.morphs import Morphs, morphs_of
from facepipe_gltf.options import Options
from facepipe_gltf.placement import place, smooth_normals
from facepipe_gltf.sculpts import Sculpt, sculpts_of
from facepipe_gltf.space import Space
from facepipe_gltf.vertices import Corners, corners_of


@dataclass(frozen=True)
class Baked:
    """Everything of one mesh that its primitives draw from; float64, metres, Y up."""

    mesh: Mesh
    corners: Corners
    points: FloatArray  # (n, 3)
    point_normals: FloatArray  # (n, 3) unit
    corner_normals: FloatArray | None  # (m, 3) unit, by Corners.normal_indices
    sculpts: Sequence[Sculpt]
    morphs: Morphs  # of the sculpts
    influences: Influences | None  # None: not skinned in the file


def bake(parts: FaceParts, mesh: Mesh, shapes: Sequence[str], space: Space, options: Options) -> Baked:
    """A mesh of the face in glTF space, with the `shapes` that move it.

    :raises ExportError: skin weights that can't be normalised, or morph targets of one name
    """
    skinned = mesh.skin is not None and options.mode != "morph"
    placement = place(mesh, parts.skeleton, space, skinned)
    corners = corners_of(mesh, placement.mirrored)
    points = placement.points(mesh.points)
    normals = smooth_normals(points, corners.points)
    corner_normals = None
    if corners.normals is not None:
        at_corner = np.zeros(len(corners.normals), np.int64)
        at_corner[np.asarray(corners.normal_indices)] = corners.points
        corner_normals = _filled(placement.normals(corners.normals, at_corner), normals[at_corner])
    elif mesh.normals is not None:
        normals = _filled(placement.normals(mesh.normals), normals)
    sculpts = sculpts_of(mesh, shapes)
    return Baked(
        mesh=mesh,
        corners=corners,
        points=points,
        point_normals=normals,
        corner_normals=corner_normals,
        sculpts=sculpts,
        morphs=morphs_of(sculpts, placement, normals),
        influences=limit(mesh.skin, options.influences, f"{parts.name} -> {mesh.name}")
        if mesh.skin is not None and skinned
        else None,
    )


def grids(meshes: Sequence[Baked]) -> list[Grid]:
    """A quantisation grid per mesh: skinned meshes share one, since they share their inverse binds."""
    skinned = [one for one in meshes if one.influences is not None]
    common = grid_around([one.points for one in skinned], [one.morphs.offsets for one in skinned])
    return [common if one.influences is not None else grid_around([one.points], [one.morphs.offsets]) for one in meshes]


def quantisation_error(baked: Baked, grid: Grid) -> float:
    """Largest distance in metres that quantisation moves a point, at neutral or at any one shape."""
    encoding = Encoding(grid)
    base = decode(encoding.positions(baked.points)) * grid.half + grid.center - baked.points
    offsets = baked.morphs.offsets
    error = decode(encoding.offsets(offsets)) * grid.half - offsets
    return max(_longest(base), _longest(base[baked.morphs.points] + error))


def _filled(normals: FloatArray, fallback: FloatArray) -> FloatArray:
    """`normals`, with `fallback` where they have no length."""
    empty = np.linalg.norm(normals, axis=1, keepdims=True) == 0
    return np.where(empty, fallback, normals)


def _longest(vectors: FloatArray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
