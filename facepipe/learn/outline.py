"""What is fixed about where surfaces end: the edges of a mesh and its connected parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.core.arrays import IntArray
from facepipe.geometry.polygons import components


@dataclass(frozen=True, kw_only=True)
class Outline:
    """The topology that `facepipe.learn.antialias` needs, made once a mesh."""

    triangles: Tensor  # (t, 3) int64
    edges: Tensor  # (e, 4) int64: both ends, then the corners across from it in the triangles on its sides
    parts: Tensor  # (t,) int64 number of the connected part that each triangle belongs to

    @classmethod
    def of(cls, triangles: IntArray, point_count: int, device: torch.device | str = "cpu") -> Outline:
        """The outline of triangles (t, 3)."""
        triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        part = components(point_count, np.concatenate([triangles[:, :2], triangles[:, 1:]]))
        numbers = (triangles, mesh_edges(triangles), part[triangles[:, 0]].astype(np.int64))
        one, other, last = (torch.as_tensor(each, device=device) for each in numbers)
        return cls(triangles=one, edges=other, parts=last)


def mesh_edges(triangles: IntArray) -> npt.NDArray[np.int64]:
    """(e, 4) edges of triangles (t, 3): both ends, then the corners across from it in the triangles on its sides.

    An edge of one triangle has its corner twice. Edges of more than two are left out: they lie inside a surface.
    """
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    across = np.concatenate([triangles[:, (i + 2) % 3] for i in range(3)])
    pairs, owner, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(owner.ravel(), kind="stable")
    last = np.cumsum(count) - 1
    edges = np.column_stack([pairs, across[order[last - count + 1]], across[order[last]]])
    return np.asarray(edges[count <= 2])
