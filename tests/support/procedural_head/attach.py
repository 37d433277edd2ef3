"""Points on the front of the head, held by the triangles under them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_triangles
from procedural_head import topology


@dataclass(frozen=True)
class Attachment:
    """For each point three head points and their barycentric shares."""

    corners: IntArray  # (n, 3)
    shares: FloatArray  # (n, 3)

    def carry(self, values: FloatArray) -> FloatArray:
        """Head values (points, ...) brought to the attached points (n, ...)."""
        return np.asarray(np.einsum("nk,nk...->n...", self.shares, values[self.corners]))


def frontal(head: FloatArray, xy: FloatArray, candidates: IntArray) -> Attachment:
    """Attach (n, 2) frontal positions to the head's triangles among the `candidates` points, foremost first."""
    top = topology.build()
    triangles = point_triangles(top.face_vertex_counts, top.face_vertex_indices)
    wanted = np.zeros(len(head), dtype=bool)
    wanted[candidates] = True
    triangles = triangles[wanted[triangles].all(axis=1)]
    a, b, c = (head[triangles[:, i], :2] for i in range(3))
    area = _cross(b - a, c - a)
    keep = area > 1e-9
    triangles, a, b, c, area = triangles[keep], a[keep], b[keep], c[keep], area[keep]
    p = xy[:, None]
    shares = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=-1) / area[:, None]
    best = shares.min(axis=-1).argmax(axis=1)
    found = np.clip(shares[np.arange(len(xy)), best], 0.0, 1.0)
    return Attachment(triangles[best], found / found.sum(axis=1, keepdims=True))


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
