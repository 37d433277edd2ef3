"""A mesh in glTF space: points, normals, corners and morph offsets, not yet split into primitives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.parts import FaceParts, FloatArray, Mesh
from facepipe_gltf.encoding import Encoding, Grid, decode, grid_around
from facepipe_gltf.influences import Influences, limit
from facepipe_gltf.morph_normals import with_normals
from facepipe_gltf.morphs import Morphs, blocks
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Placement, place, smooth_normals
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
    placement: Placement
    influences: Influences | None  # None: not skinned in the file

    def morphs(self) -> Iterator[Morphs]:
        """The offsets of all sculpts, block by block."""
        return blocks(self.sculpts, self.placement, self.point_normals)


def bake(parts: FaceParts, mesh: Mesh, shapes: Sequence[str], space: Space, options: Options) -> Baked:
    """A mesh of the face in glTF space, with the `shapes` that move it.

    :raises ExportError: skin weights that can't be normalised, or morph targets of one name
    """
    skinned = mesh.skin is not None and options.mode != "morph"
    placement = place(mesh, parts.skeleton, space, skinned)
    corners = corners_of(mesh, placement.mirrored)
    points = placement.points(mesh.points)
    normals, corner_normals = _normals(mesh, corners, points, placement)
    sculpts = sculpts_of(mesh, shapes)
    if options.morph_normals and sculpts:
        authored = corners.points[:, ::-1] if placement.mirrored else corners.points
        sculpts = with_normals(sculpts, mesh.points, authored)
    return Baked(
        mesh=mesh,
        corners=corners,
        points=points,
        point_normals=normals,
        corner_normals=corner_normals,
        sculpts=sculpts,
        placement=placement,
        influences=limit(mesh.skin, options.influences, f"{parts.name} -> {mesh.name}")
        if mesh.skin is not None and skinned
        else None,
    )


def grids(meshes: Sequence[Baked]) -> list[Grid]:
    """A quantisation grid per mesh: skinned meshes share one, since they share their inverse binds."""
    skinned = [one for one in meshes if one.influences is not None]
    common = _grid(skinned)
    return [common if one.influences is not None else _grid([one]) for one in meshes]


def _grid(meshes: Sequence[Baked]) -> Grid:
    return grid_around([one.points for one in meshes], [block.offsets for one in meshes for block in one.morphs()])


def quantisation_error(baked: Baked, grid: Grid) -> float:
    """Upper bound in metres of how far quantisation moves a point in the bind pose, whatever shapes are on together.

    The errors of the point and of all its offsets add up, each at full weight.
    """
    encoding = Encoding(grid)
    base = decode(encoding.positions(baked.points)) * grid.half + grid.center - baked.points
    total = np.linalg.norm(base, axis=1)
    for block in baked.morphs():
        error = decode(encoding.offsets(block.offsets)) * grid.half - block.offsets
        total += np.bincount(block.points, np.linalg.norm(error, axis=1), len(total))
    return float(total.max(initial=0.0))


def _normals(
    mesh: Mesh, corners: Corners, points: FloatArray, placement: Placement
) -> tuple[FloatArray, FloatArray | None]:
    """Unit normals (n, 3) of the points, and (m, 3) of the corners where the mesh has its own there.

    Smooth normals of the surface stand in for those that are missing or have no length.
    """
    if mesh.normals is not None and corners.normals is None:
        authored = placement.normals(mesh.normals)
        empty = ~authored.any(axis=1)
        if empty.any():
            authored[empty] = smooth_normals(points, corners.points)[empty]
        return authored, None
    smooth = smooth_normals(points, corners.points)
    if corners.normals is None:
        return smooth, None
    at_corner = np.zeros(len(corners.normals), np.int64)
    at_corner[np.asarray(corners.normal_indices)] = corners.points
    own = placement.normals(corners.normals, at_corner)
    empty = ~own.any(axis=1)
    own[empty] = smooth[at_corner[empty]]
    return smooth, own
