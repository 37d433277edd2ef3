"""Tangents for normal maps.

The tangent frame follows MikkTSpace (Mikkelsen 2008): per-triangle UV gradients, projected on the vertex normal,
weighted by corner angle; vertices are split beforehand where the UV orientation flips.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def orientation(uvs: FloatArray) -> IntArray:
    """(t,) 1 where the UVs (t, 3, 2) of a triangle run the same way round as its points, 0 where mirrored.

    UVs have v down, so that the usual orientation has a negative area.
    """
    e1, e2 = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] <= 0).astype(np.int64)


def tangents(points: FloatArray, normals: FloatArray, uvs: FloatArray, triangles: IntArray) -> FloatArray:
    """(v, 4) float32 unit tangents and handedness.

    ``cross(normal, tangent) * w`` points along the texture's up direction, as OpenGL-style normal maps expect.

    :param points: (v, 3); `normals` (v, 3) unit; `uvs` (v, 2), v down; `triangles` (t, 3)
    """
    corners = points[triangles]
    uv = np.asarray(uvs, dtype=np.float64)[triangles] * (1.0, -1.0)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    sign = np.where(orientation(np.asarray(uvs, dtype=np.float64)[triangles]) == 1, 1.0, -1.0)
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * sign[:, None]
    flat = np.asarray(triangles.ravel(), dtype=np.int64)
    per_corner = _project(np.repeat(along_u, 3, axis=0), normals[flat]) * _angles(corners).reshape(-1, 1)
    summed = [np.bincount(flat, per_corner[:, axis], len(points)) for axis in range(3)]
    direction = _project(np.stack(summed, axis=1).astype(np.float64), normals)
    missing = np.linalg.norm(direction, axis=1) < 0.5
    direction[missing] = _any_tangent(normals[missing])
    handedness = np.ones(len(points))
    handedness[flat] = np.repeat(sign, 3)
    return np.concatenate([direction, handedness[:, None]], axis=1).astype(np.float32)


def _project(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    """Unit vectors in the planes of unit `normals`; zero where there is no direction."""
    flat = vectors - normals * np.einsum("ij,ij->i", vectors, normals)[:, None]
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    tiny = length <= 1e-12 * np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.where(tiny, 0.0, flat / np.where(tiny, 1.0, length)))


def _angles(corners: FloatArray) -> FloatArray:
    """(t, 3) angles of triangles (t, 3, 3)."""
    following = np.roll(corners, -1, axis=1) - corners
    preceding = np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(following, axis=2) * np.linalg.norm(preceding, axis=2)
    cosine = np.einsum("tij,tij->ti", following, preceding) / np.where(lengths == 0, 1.0, lengths)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _any_tangent(normals: FloatArray) -> FloatArray:
    axis: FloatArray = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    return _project(axis, normals)
