"""A mesh in glTF space: points, normals, corners and morph offsets, not yet split into primitives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals
from facepipe.parts import FaceParts, Mesh
from facepipe_gltf.encoding import Encoding, Influences, decode, limit
from facepipe_gltf.morphs import Corners, Morphs, Sculpt, blocks, corners_of, sculpts_of, without_small
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Placement, Space, place

_SAME = 1e-6  # smaller changes of a unit normal don't show


def _with_normals(sculpts: Sequence[Sculpt], points: FloatArray, triangles: IntArray) -> list[Sculpt]:
    """The sculpts with normal offsets: authored ones, else the change of the surface's smooth normals.

    :param points: (n, 3) of the mesh, in its own space as the sculpts are; `triangles` (t, 3) as authored
    """
    neutral = np.asarray(points, dtype=np.float64)
    normals = point_normals(neutral, triangles)
    result = []
    for sculpt in sculpts:
        if sculpt.normal_offsets is not None:
            result.append(sculpt)
            continue
        offsets = np.zeros_like(neutral)
        offsets[sculpt.point_indices] = sculpt.offsets
        moved = np.zeros(len(neutral), np.bool_)
        moved[sculpt.point_indices] = True
        turned = moved.copy()  # the neighbours of moved points turn too
        turned[triangles[_touching(triangles, moved)]] = True
        rows = np.flatnonzero(turned)
        change = (point_normals(neutral + offsets, triangles[_touching(triangles, turned)]) - normals)[rows]
        x, y, z = np.abs(change).T
        same = (x < _SAME) & (y < _SAME) & (z < _SAME)
        change[same] = 0.0
        kept = ~same | moved[rows]
        points_kept = rows[kept]
        result.append(
            replace(sculpt, point_indices=points_kept, offsets=offsets[points_kept], normal_offsets=change[kept])
        )
    return result


def _touching(triangles: IntArray, points: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(t,) triangles that have one of the flagged points."""
    a, b, c = triangles.T
    return np.asarray(points[a] | points[b] | points[c])


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
    corner_normals = None
    # smooth normals of the surface stand in for those that are missing or have no length: glTF asks for unit ones
    if mesh.normals is not None and corners.normals is None:
        normals = placement.normals(mesh.normals)
        empty = ~normals.any(axis=1)
        if empty.any():
            normals[empty] = point_normals(points, corners.points)[empty]
    else:
        normals = point_normals(points, corners.points)
    if corners.normals is not None:
        at_corner = np.zeros(len(corners.normals), np.int64)
        at_corner[np.asarray(corners.normal_indices)] = corners.points
        corner_normals = placement.normals(corners.normals, at_corner)
        empty = ~corner_normals.any(axis=1)
        corner_normals[empty] = normals[at_corner[empty]]
    sculpts = sculpts_of(mesh, shapes)
    if options.with_target_normals and sculpts:
        # sculpts are still in mesh space: corners reversed for a mirrored placement would turn their normals inwards
        authored = corners.points[:, ::-1] if placement.mirrored else corners.points
        sculpts = _with_normals(sculpts, mesh.points, authored)
    influences = None
    if mesh.skin is not None and skinned:
        influences = limit(mesh.skin, options.most_influences, f"{parts.name} -> {mesh.name}")
    return Baked(mesh, corners, points, normals, corner_normals, sculpts, placement, influences)


def storage_error(baked: Baked, encoding: Encoding, smallest: float) -> float:
    """Upper bound of a point's error in the bind pose, in metres, for any weights 0 to 1 of all shapes.

    Errors of a point's offsets, quantised or left out, add up: along each axis those of one sign.
    """
    sums = np.zeros((2, 3, len(baked.points)))
    for block in baked.morphs():
        error = decode(encoding.offsets(without_small(block, smallest).offsets)) - block.offsets
        for sign, total in zip((1, -1), sums, strict=True):
            for axis, own in zip(np.maximum(sign * error.T, 0), total, strict=True):
                own += np.bincount(block.points, axis, len(own))
    return float(np.linalg.norm(sums.max(axis=0), axis=0).max(initial=0.0))


def weight_error(baked: Baked, encoding: Encoding) -> float:
    """Largest error of a point's skin weights as stored, summed over its joints."""
    if baked.influences is None:
        return 0.0
    weights = baked.influences.weights
    return float(np.abs(decode(encoding.weights(weights)) - weights).sum(axis=1).max(initial=0.0))
