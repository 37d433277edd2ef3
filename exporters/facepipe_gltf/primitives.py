"""Primitives: the vertices of one mesh that share a material, with their attributes and morph targets."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.parts import FloatArray, IntArray
from facepipe_gltf.baking import Baked
from facepipe_gltf.buffers import Buffers
from facepipe_gltf.encoding import Encoded, Encoding
from facepipe_gltf.morphs import Rows, Table, rows_of, table_of
from facepipe_gltf.tangents import orientation, tangents
from facepipe_gltf.vertices import Vertices, vertices_of

Json = dict[str, Any]


class PrimitiveWriter:
    """Writes the primitives of one mesh into `buffers`."""

    def __init__(self, baked: Baked, encoding: Encoding, buffers: Buffers, joint_count: int) -> None:
        self._baked = baked
        self._encoding = encoding
        self._buffers = buffers
        self._joint_type = np.uint8 if joint_count <= 1 << 8 else np.uint16
        self.vertex_count = 0
        self.triangle_count = 0

    def write(self, triangles: IntArray, material: int, *, tangent_uv: int | None, colored: bool) -> Json:
        """A primitive of the mesh's `triangles`; with tangents for UV set `tangent_uv`, with COLOR_0 if `colored`."""
        corners = self._baked.corners
        extra = None
        if tangent_uv is not None:
            uvs = corners.uvs[tangent_uv][corners.uv_indices[tangent_uv][triangles]]
            extra = orientation(uvs.astype(np.float64))
        vertices = vertices_of(corners, triangles, extra)
        self.vertex_count += len(vertices.points)
        self.triangle_count += len(vertices.triangles)
        primitive: Json = {
            "attributes": self._attributes(vertices, tangent_uv, colored),
            "indices": self._indices(vertices),
            "material": material,
        }
        if self._baked.sculpts:
            primitive["targets"] = self._targets(vertices)
        return primitive

    def _attributes(self, vertices: Vertices, tangent_uv: int | None, colored: bool) -> dict[str, int]:
        baked, encoding = self._baked, self._encoding
        points = baked.points[vertices.points]
        normals = self._normals(vertices)
        uvs = [values[indices] for values, indices in zip(baked.corners.uvs, vertices.uv_indices, strict=True)]
        attributes = {
            "POSITION": self._add(encoding.positions(points), bounds=True),
            "NORMAL": self._add(encoding.directions(normals)),
        }
        if tangent_uv is not None:
            found = tangents(points, normals, uvs[tangent_uv], vertices.triangles)
            attributes["TANGENT"] = self._add(encoding.directions(found))
        for i, values in enumerate(uvs):
            attributes[f"TEXCOORD_{i}"] = self._add(encoding.uvs(values))
        if colored and baked.mesh.colors is not None:
            attributes["COLOR_0"] = self._add(encoding.colors(np.asarray(baked.mesh.colors)[vertices.points]))
        attributes |= self._skin(vertices.points)
        attributes["_FACEPIPE_POINT"] = self._add(Encoded(vertices.points.astype(np.float32), False))
        return attributes

    def _normals(self, vertices: Vertices) -> FloatArray:
        if self._baked.corner_normals is not None and vertices.normal_indices is not None:
            return self._baked.corner_normals[vertices.normal_indices]
        return self._baked.point_normals[vertices.points]

    def _skin(self, points: IntArray) -> dict[str, int]:
        if self._baked.influences is None:
            return {}
        joints, weights, _ = self._baked.influences
        used = int((weights > 0).sum(axis=1).max(initial=1))
        sets = 1 if used <= 4 else 2
        padded = [np.zeros((len(points), 4 * sets)), np.zeros((len(points), 4 * sets))]
        for target, source in zip(padded, (joints, weights), strict=True):
            width = min(source.shape[1], 4 * sets)
            target[:, :width] = source[points, :width]
        stored = self._encoding.weights(padded[1])
        kept = np.where(stored.array > 0, padded[0], 0).astype(self._joint_type)
        attributes = {}
        for i in range(sets):
            part = slice(4 * i, 4 * i + 4)
            attributes[f"JOINTS_{i}"] = self._add(Encoded(kept[:, part], False))
            attributes[f"WEIGHTS_{i}"] = self._add(Encoded(stored.array[:, part], stored.normalized))
        return attributes

    def _indices(self, vertices: Vertices) -> int:
        # 65535 is left out: it restarts primitives
        kind = np.uint16 if len(vertices.points) <= 65535 else np.uint32
        return self._buffers.add(vertices.triangles.astype(kind).ravel(), "index")

    def _targets(self, vertices: Vertices) -> list[dict[str, int]]:
        """One target per sculpt, all with the same attributes."""
        count = len(vertices.points)
        positions = rows_of(self._offsets, vertices)
        targets = [{"POSITION": rows} for rows in positions]
        if self._normal_offsets is not None:
            for target, rows in zip(targets, self._normal_rows(vertices, *self._normal_offsets), strict=True):
                target["NORMAL"] = rows
        return [
            {name: self._buffers.add_morph(rows, count, bounds=name == "POSITION") for name, rows in target.items()}
            for target in targets
        ]

    def _normal_rows(self, vertices: Vertices, precise: Table, compact: Table | None) -> list[Rows]:
        """Offsets of normals; those beyond -1..1 keep float32, since integers can't hold them."""
        rows = rows_of(precise, vertices)
        if compact is None:
            return rows
        fits = [min(one.extent.low) >= -1 and max(one.extent.high) <= 1 for one in rows]
        pairs = zip(rows, rows_of(compact, vertices), fits, strict=True)
        return [small if fit else large for large, small, fit in pairs]

    @cached_property
    def _offsets(self) -> Table:
        morphs = self._baked.morphs
        return table_of(morphs, self._encoding.offsets(morphs.offsets))

    @cached_property
    def _normal_offsets(self) -> tuple[Table, Table | None] | None:
        """As float32, and as integers where the file has these."""
        morphs = self._baked.morphs
        if morphs.normal_offsets is None:
            return None
        precise = table_of(morphs, Encoding().directions(morphs.normal_offsets))
        if self._encoding.grid is None:
            return precise, None
        return precise, table_of(morphs, self._encoding.directions(morphs.normal_offsets))

    def _add(self, encoded: Encoded, bounds: bool = False) -> int:
        return self._buffers.add(encoded.array, "vertex", normalized=encoded.normalized, bounds=bounds)


def by_material(baked: Baked) -> Sequence[tuple[str | None, IntArray]]:
    """Material names with the triangles (t,) that use them, the mesh's own first; only those that have some."""
    mesh = baked.mesh
    names = list(dict.fromkeys([mesh.material, *(one.material for one in mesh.material_faces)]))
    number = np.zeros(len(mesh.face_vertex_counts), np.int64)
    for one in mesh.material_faces:
        number[np.asarray(one.faces, dtype=np.int64)] = names.index(one.material)
    of_triangle = number[baked.corners.faces]
    groups = [(name, np.flatnonzero(of_triangle == i)) for i, name in enumerate(names)]
    return [(name, triangles) for name, triangles in groups if len(triangles)]
