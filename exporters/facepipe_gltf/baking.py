"""A mesh in glTF space: corners and vertices, points and normals, and its morph targets, not yet split into primitives.

Targets are tables of many: each step is one pass over a block instead of one per target. A block stays in the
processor's cache, and its memory serves the next one: fresh memory costs more than the arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.geometry.polygons import point_normals, touching, triangulate
from facepipe.parts import FaceParts, Mesh, exact
from facepipe.records import Json
from facepipe_gltf.buffers import Encoded, Encoding, Extent, Influences, Rows, decode, limit, require_finite
from facepipe_gltf.options import Options
from facepipe_gltf.placement import Placement, Space, place

Knots = tuple[tuple[float, float], ...]
_LINEAR: dict[float, Knots] = {1.0: ((0.0, 0.0), (1.0, 1.0))}
_BLOCK = 1 << 15  # rows
_HOLDS = ("CORNERS", "SHARES", "OFFSET")
_SAME = 1e-6  # smaller changes of a unit normal don't show


@dataclass(frozen=True)
class Corners:
    """The corners of all triangles of a mesh: which point, UV and normal each one has."""

    point_count: int
    faces: IntArray  # (t,) the face of each triangle
    points: IntArray  # (t, 3)
    uv_indices: tuple[IntArray, ...]  # per UV set (t, 3) into its values
    uvs: tuple[FloatArray, ...]  # per UV set (u, 2) float32, v down
    normal_indices: IntArray | None  # (t, 3) into normals
    normals: FloatArray | None  # (m, 3) float32 face-varying normals as authored


def corners_of(mesh: Mesh, mirrored: bool) -> Corners:
    """Corners of the triangulated faces, without triangles that use a point twice.

    `mirrored` turns every triangle round, for points that a reflection has moved.
    """
    triangles = triangulate(mesh.face_vertex_counts)
    faces, corners = triangles.faces, triangles.corners
    if mirrored:
        corners = np.ascontiguousarray(corners[:, ::-1])
    points = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
    a, b, c = points.T
    # by points, not by area: a flat triangle of three points may open in a shape
    solid = (a != b) & (b != c) & (c != a)
    if not solid.all():
        faces, corners, points = faces[solid], corners[solid], points[solid]
    uv_indices = tuple(
        points if uv_set.indices is None else np.asarray(uv_set.indices, dtype=np.int64)[corners]
        for uv_set in mesh.uv_sets
    )
    values = [np.asarray(uv_set.values, dtype=np.float64).reshape(-1, 2) for uv_set in mesh.uv_sets]
    uvs = tuple(_plain_zeros((uv * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)) for uv in values)  # v down
    normals = normal_indices = None
    if mesh.normals is not None and len(mesh.normals) == len(mesh.face_vertex_indices) != len(mesh.points):
        normals, normal_indices = _plain_zeros(np.asarray(mesh.normals, dtype=np.float32)), corners
    return Corners(len(mesh.points), faces, points, uv_indices, uvs, normal_indices, normals)


@dataclass(frozen=True)
class Vertices:
    """The vertices (v) and triangles (t, 3) of one primitive, in the order of their points."""

    points: IntArray  # (v,) ascending
    uv_indices: tuple[IntArray, ...]  # per UV set (v,)
    normal_indices: IntArray | None  # (v,)
    triangles: IntArray  # (t, 3)
    starts: IntArray  # (n + 1,) first vertex of every point of the mesh, and the end


def vertices_of(corners: Corners, chosen: IntArray, extra: IntArray | None = None) -> Vertices:
    """Vertices of the `chosen` triangles: one per distinct point, UVs, normal and `extra` (t,) triangle number.

    Vertices of one point are in the order of the values that make them differ.
    """
    points = corners.points[chosen].ravel()
    pairs = list(zip(corners.uv_indices, corners.uvs, strict=True))
    if corners.normal_indices is not None and corners.normals is not None:
        pairs.append((corners.normal_indices, corners.normals))
    # what may split a point: an index (c,) into values (u, columns) at every corner
    attributes = [(indices[chosen].ravel(), values) for indices, values in pairs]
    if extra is not None:
        attributes.append((np.repeat(extra, 3), np.arange(2, dtype=np.float32)[:, None]))
    first = np.full(corners.point_count, -1, np.int64)  # a corner of each point
    first[points] = np.arange(len(points))
    # most points are one vertex: only corners of points that have several values are sorted by these
    split = np.zeros(len(first), np.bool_)
    reference = first[points]
    for indices, values in attributes:
        other = np.flatnonzero(indices != indices[reference])
        unlike = (values[indices[other]] != values[indices[reference[other]]]).any(axis=1)
        split[points[other[unlike]]] = True
    seams = np.flatnonzero(split[points])
    # the vertex (c,) that each corner at a seam becomes, and a corner of each such vertex, in the order of points
    keys = [points[seams], *(column for indices, values in attributes for column in values[indices[seams]].T)]
    sorted_seams = np.lexsort(keys[::-1])
    changes = np.zeros(len(seams), np.bool_)
    changes[:1] = True
    for key in keys:
        changes[1:] |= key[sorted_seams][1:] != key[sorted_seams][:-1]
    of_seam = np.empty(len(seams), np.int64)
    of_seam[sorted_seams] = np.cumsum(changes) - 1
    seam_corners = sorted_seams[changes]
    counts = (first >= 0).astype(np.int64)
    on_seam = points[seams[seam_corners]]  # the point of each vertex at a seam
    counts[on_seam] = 0
    counts += np.bincount(on_seam, minlength=len(counts))
    starts = np.concatenate([[0], np.cumsum(counts)])
    corner = np.empty(starts[-1], np.int64)  # one that each vertex stands for
    used = np.flatnonzero(counts)
    corner[starts[used]] = first[used]
    numbers = starts[on_seam] + np.arange(len(on_seam)) - np.searchsorted(on_seam, on_seam)
    corner[numbers] = seams[seam_corners]
    triangles = starts[points]
    triangles[seams] = numbers[of_seam]
    return Vertices(
        points=points[corner],
        uv_indices=tuple(indices[corner] for indices, _ in attributes[: len(corners.uvs)]),
        normal_indices=None if corners.normals is None else attributes[len(corners.uvs)][0][corner],
        triangles=triangles.reshape(-1, 3),
        starts=starts,
    )


def _plain_zeros(values: FloatArray) -> FloatArray:
    """float32 `values` without negative zeros."""
    return np.asarray(values + np.float32(0))


@dataclass(frozen=True)
class Sculpt:
    """One morph target of a mesh: a shape, or one of its inbetweens."""

    name: str
    label: str  # in the file; several may share one
    shape: str
    weight: float  # shape weight at which it is fully active
    knots: Knots  # activation over the shape's weight, piecewise linear, its ends extended
    point_indices: IntArray
    offsets: FloatArray
    normal_offsets: FloatArray | None

    @property
    def is_inbetween(self) -> bool:
        """Whether it is one of a shape's inbetweens."""
        return self.weight != 1.0


def sculpts_of(mesh: Mesh, shapes: Sequence[str]) -> list[Sculpt]:
    """The morph targets of a mesh: its shapes in stage order, each followed by its inbetweens."""
    sculpts: list[Sculpt] = []
    for shape in (one for one in mesh.blendshapes if one.name in shapes):
        weights = [one.weight for one in shape.inbetweens]
        if weights and len({0.0, 1.0, *weights}) != len(weights) + 2:
            raise ExportError(
                f"{mesh.name} -> {shape.name}", f"inbetween weights {weights}, expected distinct ones, no 0 or 1"
            )
        knots = _LINEAR
        if weights:
            from facepipe.rig.rig import curves

            knots = {weight: curve.knots for weight, curve in curves(tuple(weights)).items()}
        sculpts += [
            Sculpt(
                name=name,
                label=name if weights else exact(shape),  # inbetweens name their shape
                shape=shape.name,
                weight=weight,
                knots=knots[weight],
                point_indices=shape.point_indices,
                offsets=sculpt.offsets,
                normal_offsets=sculpt.normal_offsets,
            )
            for name, weight, sculpt in shape.sculpts
        ]
    taken: set[str] = set()
    for one in sculpts:
        if one.name in taken:
            raise ExportError(f"{mesh.name} -> {one.name}", "two morph targets of this name, expected one")
        taken.add(one.name)
    return sculpts


def extras(sculpts: Sequence[Sculpt]) -> Json:
    """What an engine needs to drive inbetweens: the shape and weight of each, and activation curves."""
    inbetweens = {
        sculpt.name: {"shape": sculpt.shape, "weight": sculpt.weight} for sculpt in sculpts if sculpt.is_inbetween
    }
    curves = {sculpt.name: [list(knot) for knot in sculpt.knots] for sculpt in sculpts if len(sculpt.knots) > 2}
    return {"inbetweens": inbetweens, "curves": curves} if inbetweens else {}


class Morphs(NamedTuple):
    """The offsets of some targets of a mesh, one target after another; float64, metres, Y up."""

    starts: IntArray  # (targets + 1,) first row of each target, and the end
    points: IntArray  # (k,) ascending within a target
    offsets: FloatArray  # (k, 3)
    normal_offsets: FloatArray | None  # (k, 3), zero for targets without; None: no target of the mesh has any


class Table(NamedTuple):
    """One attribute of a block of targets as it is stored, without the rows that are zero."""

    starts: IntArray  # (targets + 1,)
    points: IntArray  # (k,)
    values: npt.NDArray[Any]  # (k, 3)
    normalized: bool


def blocks(sculpts: Sequence[Sculpt], placement: Placement, normals: FloatArray) -> Iterator[Morphs]:
    """All sculpts of a mesh in glTF space, block by block.

    :param normals: (n, 3) unit normals of the mesh's points in glTF space
    """
    with_normals = any(one.normal_offsets is not None for one in sculpts)
    every: list[list[Sculpt]] = []
    rows = 0
    for sculpt in sculpts:
        rows += len(sculpt.point_indices)
        # a sculpt is never parted, however large: a block is then larger
        if rows > _BLOCK or not every:
            every.append([])
            rows = len(sculpt.point_indices)
        every[-1].append(sculpt)
    for block in every:
        starts = np.cumsum([0, *(len(sculpt.point_indices) for sculpt in block)])
        points = np.concatenate([sculpt.point_indices for sculpt in block], dtype=np.int64)
        offsets = placement.offsets(np.concatenate([sculpt.offsets for sculpt in block]), points)
        turned = None
        if with_normals:
            pairs = [(one.normal_offsets, one.offsets) for one in block]
            own = np.concatenate([np.zeros_like(offset) if normal is None else normal for normal, offset in pairs])
            turned = placement.normal_offsets(own, normals[points], points)
        yield Morphs(starts, points, offsets, turned)


def without_small(morphs: Morphs, smallest: float) -> Morphs:
    """Offsets shorter than `smallest` metres become zero, and those of their normals with them."""
    if not smallest:
        return morphs
    long = np.linalg.norm(morphs.offsets, axis=1, keepdims=True) >= smallest
    normals = None if morphs.normal_offsets is None else morphs.normal_offsets * long
    return morphs._replace(offsets=morphs.offsets * long, normal_offsets=normals)


def table_of(morphs: Morphs, encoded: Encoded) -> Table:
    """The rows (k, 3) of `encoded` that are not zero.

    :raises ExportError: numbers that left the range of float32 on their way to metres
    """
    starts, points, values = morphs.starts, morphs.points, encoded.array
    require_finite(values)
    x, y, z = values.T
    moving = (x != 0) | (y != 0) | (z != 0)
    if not moving.all():
        kept = np.flatnonzero(moving)
        starts, points, values = np.searchsorted(kept, starts), points[kept], values.take(kept, axis=0)
    return Table(starts, points, values, encoded.normalized)


def rows_of(table: Table, vertices: Vertices) -> list[Rows]:
    """The rows of each target for the vertices of one primitive."""
    # most points are one vertex; those that the primitive does not have and those at seams are rare, and looked up
    # by byte-sized masks
    copies = np.diff(vertices.starts)
    points, starts, values = table.points, table.starts, table.values
    source: IntArray | None = None  # the row of the table for each row; None: each once
    inside = (copies > 0)[points]
    if not inside.all():
        source = np.flatnonzero(inside)
        points, starts = points[source], np.searchsorted(source, starts)
    moved = vertices.starts[points]
    seams = np.flatnonzero((copies > 1)[points])
    if len(seams):
        extra = copies[points[seams]] - 1
        after = np.repeat(seams + 1, extra)  # further vertices of a point follow its first
        steps = np.arange(int(extra.sum())) - np.repeat(np.cumsum(extra) - extra, extra) + 1
        moved = np.insert(moved, after, moved[after - 1] + steps)
        source = np.arange(len(points)) if source is None else source
        source = np.insert(source, after, source[after - 1])
        starts = starts + np.searchsorted(after, starts, side="right")
    if source is not None:
        values = values.take(source, axis=0)
    # per target, of all vertices of the primitive: those that stay zero count too
    sizes = np.diff(starts)
    filled = np.flatnonzero(sizes)
    low = np.zeros((len(sizes), 3), values.dtype)
    high = np.zeros((len(sizes), 3), values.dtype)
    if len(filled):
        axes = np.ascontiguousarray(values.T)
        low[filled] = np.minimum.reduceat(axes, starts[filled], axis=1).T
        high[filled] = np.maximum.reduceat(axes, starts[filled], axis=1).T
    partial = sizes < len(vertices.points)
    low[partial] = np.minimum(low[partial], 0)
    high[partial] = np.maximum(high[partial], 0)
    extents = [Extent(*pair) for pair in zip(low.tolist(), high.tolist(), strict=True)]
    bounds = zip(starts[:-1].tolist(), starts[1:].tolist(), extents, strict=True)
    return [Rows(moved[a:b], values[a:b], extent, table.normalized) for a, b, extent in bounds]


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
        turned[triangles[touching(triangles, moved)]] = True
        rows = np.flatnonzero(turned)
        change = (point_normals(neutral + offsets, triangles[touching(triangles, turned)]) - normals)[rows]
        x, y, z = np.abs(change).T
        same = (x < _SAME) & (y < _SAME) & (z < _SAME)
        change[same] = 0.0
        kept = ~same | moved[rows]
        points_kept = rows[kept]
        result.append(
            replace(sculpt, point_indices=points_kept, offsets=offsets[points_kept], normal_offsets=change[kept])
        )
    return result


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

    @property
    def holds(self) -> dict[str, npt.NDArray[np.float32]]:
        """By attribute, (n, ...) what points lie on: corners, shares of the first two, and metres from there."""
        own = self.mesh.holds
        if own is None:
            return {}
        values = (own.corners, own.shares[:, :2], self.placement.offsets(own.offsets))
        return {f"_FACEPIPE_{name}": np.asarray(one, np.float32) for name, one in zip(_HOLDS, values, strict=True)}

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
    if options.with_target_normals and sculpts and (options.restorable or _is_skin(mesh, parts)):
        # sculpts are still in mesh space: corners reversed for a mirrored placement would turn their normals inwards
        authored = corners.points[:, ::-1] if placement.mirrored else corners.points
        sculpts = _with_normals(sculpts, mesh.points, authored)
    influences = None
    if mesh.skin is not None and skinned:
        influences = limit(mesh.skin, options.most_influences, f"{parts.name} -> {mesh.name}")
    return Baked(mesh, corners, points, normals, corner_normals, sculpts, placement, influences)


def _is_skin(mesh: Mesh, parts: FaceParts) -> bool:
    """Whether it is no teeth, gums, eyes or hair.

    Of a file that is to be small these do without the normals of targets: 0.5 of 4.4 MB, and in no picture to be seen.
    """
    from facepipe_gltf.merging import role_of

    return role_of(mesh, {material.name: material for material in parts.materials}) is None


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
