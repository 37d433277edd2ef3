"""Normals of a mesh, with gradients to its points."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from facepipe.core.arrays import IntArray
from facepipe.learn.fixed_matrix import FixedMatrix
from facepipe.learn.rows import take


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
