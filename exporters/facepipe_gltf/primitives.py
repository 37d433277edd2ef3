"""Primitives: the vertices of one mesh that share a material, with their attributes and morph targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.records import Json
from facepipe_gltf.baking import Baked, Vertices, rows_of, table_of, vertices_of, without_small
from facepipe_gltf.buffers import Buffers, Encoded, Encoding, Rows
from facepipe_gltf.materials import VARIANTS, Surface
from facepipe_gltf.options import Options
from facepipe_gltf.record_format import material_groups

_MOST_SHORT = 65535  # vertices whose numbers fit 16 bits: the largest of these is left out, it restarts primitives


def _orientation(uvs: FloatArray) -> IntArray:
    """(t,) 1 where the UVs (t, 3, 2) of a triangle run the same way round as its points, 0 where mirrored.

    UVs have v down, so that the usual orientation has a negative area.
    """
    e1, e2 = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] <= 0).astype(np.int64)


def _tangents(points: FloatArray, normals: FloatArray, uvs: FloatArray, triangles: IntArray) -> FloatArray:
    """(v, 4) float32 unit tangents and handedness.

    The frame follows MikkTSpace (Mikkelsen 2008): per-triangle UV gradients, projected on the vertex normal,
    weighted by corner angle; vertices are split beforehand where the UV orientation flips.
    ``cross(normal, tangent) * w`` points along the texture's up direction, as OpenGL-style normal maps expect.

    :param points: (v, 3); `normals` (v, 3) unit; `uvs` (v, 2), v down; `triangles` (t, 3)
    """
    corners = points[triangles]
    uv = np.asarray(uvs, dtype=np.float64)[triangles] * (1.0, -1.0)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    sign = np.where(_orientation(np.asarray(uvs, dtype=np.float64)[triangles]) == 1, 1.0, -1.0)
    # (e1 dv2 - e2 dv1) / det, of which only det's sign counts once normalised: no division by a UV sliver's area
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * sign[:, None]
    flat = np.asarray(triangles.ravel(), dtype=np.int64)
    following = np.roll(corners, -1, axis=1) - corners
    preceding = np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(following, axis=2) * np.linalg.norm(preceding, axis=2)
    cosine = np.einsum("tij,tij->ti", following, preceding) / np.where(lengths == 0, 1.0, lengths)
    angles = np.arccos(np.clip(cosine, -1.0, 1.0))
    per_corner = _project(np.repeat(along_u, 3, axis=0), normals[flat]) * angles.reshape(-1, 1)
    summed = [np.bincount(flat, per_corner[:, axis], len(points)) for axis in range(3)]
    direction = _project(np.stack(summed, axis=1).astype(np.float64), normals)
    missing = np.linalg.norm(direction, axis=1) < 0.5
    any_axis: FloatArray = np.eye(3)[np.argmin(np.abs(normals[missing]), axis=1)]
    direction[missing] = _project(any_axis, normals[missing])
    handedness = np.ones(len(points))
    handedness[flat] = np.repeat(sign, 3)
    return np.concatenate([direction, handedness[:, None]], axis=1).astype(np.float32)


def _project(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    """Unit vectors in the planes of unit `normals`; zero where there is no direction."""
    flat = vectors - normals * np.einsum("ij,ij->i", vectors, normals)[:, None]
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    tiny = length <= 1e-12 * np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.where(tiny, 0.0, flat / np.where(tiny, 1.0, length)))


class PrimitiveWriter:
    """Writes the primitives of one mesh into `buffers`."""

    def __init__(self, baked: Baked, options: Options, buffers: Buffers, joint_count: int) -> None:
        self._baked = baked
        self._encoding = Encoding(bool(options.quantize))
        self._restorable, self._with_points = options.restorable, options.with_points
        self._smallest = options.drop_deltas / 1000
        self._buffers = buffers
        self._joint_type = np.uint8 if joint_count <= 1 << 8 else np.uint16

    def write(self, shown: Sequence[tuple[IntArray, Surface]]) -> list[Json]:
        """The primitives of the mesh: numbers of the triangles that show a surface, and the surface."""
        corners = self._baked.corners
        primitives: list[Json] = []
        vertices_of_all = []
        for triangles, surface in shown:
            flipped = None
            if surface.tangent_uv is not None:
                uvs = corners.uvs[surface.tangent_uv][corners.uv_indices[surface.tangent_uv][triangles]]
                flipped = _orientation(uvs.astype(np.float64))
            vertices_of_all.append(vertices_of(corners, triangles, flipped))
        # before any attribute, block by block: a block of targets is in the cache for all primitives
        targets_of_all = self._targets(vertices_of_all)
        for (_, surface), vertices, targets in zip(shown, vertices_of_all, targets_of_all, strict=True):
            count = len(vertices.points)
            kind = np.uint16 if count <= _MOST_SHORT else np.uint32
            primitive: Json = {
                "attributes": self._attributes(vertices, surface),
                "indices": self._buffers.add(vertices.triangles.astype(kind).ravel(), "index"),
                "material": surface.index,
            }
            if surface.mappings:
                primitive["extensions"] = {VARIANTS: {"mappings": list(surface.mappings)}}
            if targets:
                primitive["targets"] = [
                    {
                        name: self._buffers.add_morph(rows, count, bounds=name == "POSITION")
                        for name, rows in one.items()
                    }
                    for one in targets
                ]
            primitives.append(primitive)
        return primitives

    def _attributes(self, vertices: Vertices, surface: Surface) -> dict[str, int]:
        baked, encoding = self._baked, self._encoding
        points = baked.points[vertices.points]
        normals = baked.point_normals[vertices.points]
        if baked.corner_normals is not None and vertices.normal_indices is not None:
            normals = baked.corner_normals[vertices.normal_indices]
        uvs = [values[indices] for values, indices in zip(baked.corners.uvs, vertices.uv_indices, strict=True)]
        attributes = {
            "POSITION": self._add(encoding.positions(points), bounds=True),
            "NORMAL": self._add(encoding.directions(normals)),
        }
        if surface.tangent_uv is not None:
            found = _tangents(points, normals, uvs[surface.tangent_uv], vertices.triangles)
            attributes["TANGENT"] = self._add(encoding.directions(found))
        for i, values in enumerate(uvs):
            attributes[f"TEXCOORD_{i}"] = self._add(encoding.uvs(values))
        if surface.colored and baked.mesh.colors is not None:
            attributes["COLOR_0"] = self._add(encoding.colors(np.asarray(baked.mesh.colors)[vertices.points]))
        if baked.influences is not None:
            joints, weights, _ = baked.influences
            # a second set only where a vertex needs it: not every engine reads JOINTS_1
            sets = 1 if (weights > 0).sum(axis=1).max(initial=1) <= 4 else 2
            padded = [np.zeros((len(points), 4 * sets)), np.zeros((len(points), 4 * sets))]
            for target, source in zip(padded, (joints, weights), strict=True):
                width = min(source.shape[1], 4 * sets)
                target[:, :width] = source[vertices.points, :width]
            stored = encoding.weights(padded[1])
            kept = np.where(stored.array > 0, padded[0], 0).astype(self._joint_type)
            for i in range(sets):
                part = slice(4 * i, 4 * i + 4)
                attributes[f"JOINTS_{i}"] = self._add(Encoded(kept[:, part], False))
                attributes[f"WEIGHTS_{i}"] = self._add(Encoded(stored.array[:, part], stored.normalized))
        if self._with_points:
            attributes["_FACEPIPE_POINT"] = self._add(Encoded(vertices.points.astype(np.float32), False))
        for name, values in baked.holds.items():
            attributes[name] = self._add(Encoded(values[vertices.points], False))
        return attributes

    def _targets(self, primitives: Sequence[Vertices]) -> list[list[dict[str, Rows]]]:
        """The targets of each primitive: one per sculpt, all with the same attributes."""
        targets: list[list[dict[str, Rows]]] = [[] for _ in primitives]
        # integers can't hold offsets of normals beyond -1..1: those stay float32 in a quantised file too, but where it
        # is to be small. There they end at 1, in folds: one normal beyond would take four times the bytes for all.
        encodings = [Encoding(), self._encoding] if self._encoding.quantize else [Encoding()]
        encodings = encodings if self._restorable else encodings[-1:]
        for block in self._baked.morphs():
            morphs = without_small(block, self._smallest)
            offsets = table_of(morphs, self._encoding.offsets(morphs.offsets))
            turned = morphs.normal_offsets
            tables = [] if turned is None else [table_of(morphs, one.directions(turned)) for one in encodings]
            for of_primitive, vertices in zip(targets, primitives, strict=True):
                positions = rows_of(offsets, vertices)
                if not tables:
                    of_primitive += [{"POSITION": rows} for rows in positions]
                    continue
                large, *compact = (rows_of(table, vertices) for table in tables)
                for small in compact:
                    fits = [min(one.extent.low) >= -1 and max(one.extent.high) <= 1 for one in large]
                    large = [low if fit else one for one, low, fit in zip(large, small, fits, strict=True)]
                pairs = zip(positions, large, strict=True)
                of_primitive += [{"POSITION": rows, "NORMAL": normals} for rows, normals in pairs]
        return targets

    def _add(self, encoded: Encoded, bounds: bool = False) -> int:
        return self._buffers.add(encoded.array, "vertex", normalized=encoded.normalized, bounds=bounds)


def by_material(baked: Baked) -> Sequence[tuple[str | None, IntArray]]:
    """Material names with the triangles (t,) that use them, the mesh's own first; only those that have some."""
    names, number = material_groups(baked.mesh)
    of_triangle = number[baked.corners.faces]
    groups = [(name, np.flatnonzero(of_triangle == i)) for i, name in enumerate(names)]
    return [(name, triangles) for name, triangles in groups if len(triangles)]
