"""The opaque triangles of a face with their materials, ready to draw, and their normals, with gradients to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.polygons import triangulate
from facepipe.learn.fixed_matrix import FixedMatrix
from facepipe.learn.rasterise import take
from facepipe.parts import FaceParts, Material, Mesh, TextureInput


class PointNormals:
    """Unit normals of the points of one topology, area-weighted, as `facepipe.geometry.polygons.point_normals`."""

    def __init__(
        self,
        triangles: IntArray,
        point_count: int,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        """:param triangles: (t, 3) point numbers, counter-clockwise outside"""
        triangles = np.asarray(triangles, dtype=np.int64)
        owners = np.repeat(np.arange(len(triangles)), 3)
        entries = (np.ones(len(owners)), (triangles.ravel(), owners))
        incidence = sparse.csr_array(entries, shape=(point_count, len(triangles)))
        self._triangles = torch.as_tensor(triangles, device=device)
        self._incidence = FixedMatrix(incidence, dtype, device)

    def __call__(self, points: Tensor) -> Tensor:
        """(n, 3) unit normals of points (n, 3); (0, 1, 0) at points of no triangle with an area."""
        corners = take(points, self._triangles)
        areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = self._incidence @ areas
        square = (summed * summed).sum(dim=1, keepdim=True)
        flat = square < torch.finfo(square.dtype).tiny
        up = summed.new_tensor([0.0, 1.0, 0.0])
        return torch.where(flat, up, summed / torch.where(flat, torch.ones_like(square), square).sqrt())


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Triangles of all meshes, points numbered in mesh order."""

    triangles: IntArray  # (t, 3) point numbers, counter-clockwise outside
    materials: IntArray  # (t,) into `names`
    names: tuple[str, ...]  # of the materials; "" for surfaces without one
    colors: FloatArray  # (m, 3) linear, of each material; (1, 1, 1) where it has a texture
    textures: tuple[TextureInput | None, ...]  # (m,) diffuse textures
    uv: FloatArray  # (u, 2) texture coordinates, v up
    uv_corners: IntArray  # (t, 3) rows of `uv`


def opaque_surfaces(parts: FaceParts) -> Surfaces:
    """Everything with an opacity of 1; what lets light through, like corneas and lashes on cards, is left out.

    :raises TopologyError: a mesh refers to materials that are not there
    """
    materials = (Material(name=""), *parts.materials)
    number = {material.name: i for i, material in enumerate(materials)}
    pieces = []
    uv: list[FloatArray] = [np.zeros((1, 2))]
    first = 0
    for mesh in parts.meshes:
        corners, faces = triangulate(mesh.face_vertex_counts)
        chosen = _materials(mesh, number)[faces]
        opaque = np.array([material.opacity == 1.0 for material in materials])[chosen]
        corners, chosen = corners[opaque], chosen[opaque]
        points = np.asarray(mesh.face_vertex_indices, dtype=np.int64)[corners]
        pieces.append((points + first, chosen, _uv_rows(mesh, corners, points, materials, chosen, uv)))
        first += len(mesh.points)
    pieces.append((np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.int64)))
    triangles, of_triangle, uv_corners = (np.concatenate(column) for column in zip(*pieces, strict=True))
    textures = tuple(one.diffuse_color if isinstance(one.diffuse_color, TextureInput) else None for one in materials)
    plain = [(1.0, 1.0, 1.0) if isinstance(one.diffuse_color, TextureInput) else one.diffuse_color for one in materials]
    return Surfaces(
        triangles=triangles,
        materials=of_triangle,
        names=tuple(material.name for material in materials),
        colors=np.array(plain, dtype=np.float64),
        textures=textures,
        uv=np.concatenate(uv),
        uv_corners=uv_corners,
    )


def _materials(mesh: Mesh, number: dict[str, int]) -> IntArray:
    """(faces,) material of each face."""
    bound = [(mesh.material or "", np.arange(len(mesh.face_vertex_counts)))]
    bound += [(one.material, np.asarray(one.faces, dtype=np.int64)) for one in mesh.material_faces]
    materials = np.zeros(len(mesh.face_vertex_counts), dtype=np.int64)
    for name, faces in bound:
        if name not in number:
            raise TopologyError(mesh.name, f"material '{name}' is not among the face's materials")
        materials[faces] = number[name]
    return materials


def _uv_rows(
    mesh: Mesh,
    corners: IntArray,
    points: IntArray,
    materials: tuple[Material, ...],
    materials_used: IntArray,
    table: list[FloatArray],
) -> IntArray:
    """(t, 3) rows of the table of all UVs, to which the mesh's sets are added; row 0 where there are none."""
    rows = np.zeros(corners.shape, dtype=np.int64)
    for uv_set in mesh.uv_sets:
        used = [i for i, one in enumerate(materials) if _reads(one, uv_set.name)]
        chosen = np.isin(materials_used, used)
        within = points if uv_set.indices is None else np.asarray(uv_set.indices, dtype=np.int64)[corners]
        rows[chosen] = within[chosen] + sum(map(len, table))
        table.append(np.asarray(uv_set.values, dtype=np.float64))
    return rows


def _reads(material: Material, uv_set: str) -> bool:
    return isinstance(material.diffuse_color, TextureInput) and material.diffuse_color.uv_set == uv_set
