"""Small loose meshes: spheres with a pole at the front, and strips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import UvSet


@dataclass(frozen=True)
class Solid:
    """Points and faces of a loose mesh with its texture coordinates."""

    points: FloatArray
    counts: IntArray
    indices: IntArray
    uvs: UvSet


def sphere(polar: FloatArray, segments: int, spread: float = 1.0) -> Solid:
    """A unit sphere around the origin with poles on +Z (point 0) and -Z (the last point).

    `polar` (rings,) are the angles from +Z of its rings of `segments` points. Texture coordinates are azimuthal: the
    front pole in the middle, the radius growing with the polar angle to the power `spread`.
    """
    turn = 2 * np.pi * np.arange(segments) / segments
    angle, around = (grid.ravel() for grid in np.meshgrid(polar, turn, indexing="ij"))
    body = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)
    points = np.concatenate([[(0.0, 0.0, 1.0)], body, [(0.0, 0.0, -1.0)]])
    ids = 1 + np.arange(len(body)).reshape(len(polar), segments)
    after = np.roll(ids, -1, axis=1)
    front = np.stack([np.zeros(segments, np.int64), ids[0], after[0]], axis=1)
    bands = np.stack([ids[:-1], ids[1:], after[1:], after[:-1]], axis=-1).reshape(-1, 4)
    back = np.stack([np.full(segments, len(points) - 1), after[-1], ids[-1]], axis=1)
    counts = np.repeat([3, 4, 3], [segments, len(bands), segments])
    indices = np.concatenate([front.ravel(), bands.ravel(), back.ravel()])
    # The back pole is a circle in texture space: one value per face of its fan.
    middle = turn + np.pi / segments
    flat = np.concatenate([[0.0], angle, np.full(segments, np.pi)])
    around = np.concatenate([[0.0], around, middle])
    values = 0.5 + 0.49 * ((flat / np.pi) ** spread)[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
    uv_back = back.copy()
    uv_back[:, 0] = len(points) - 1 + np.arange(segments)
    uv_indices = np.concatenate([front.ravel(), bands.ravel(), uv_back.ravel()]).astype(np.int32)
    return Solid(points, counts.astype(np.int32), indices.astype(np.int32), UvSet(values=values, indices=uv_indices))


def strip(points: FloatArray, uv_box: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)) -> Solid:
    """A grid (rows, columns, 3) as quads, wound so that columns x rows gives the normal; uv over (u0, v0, u1, v1)."""
    rows, columns = points.shape[:2]
    ids = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]], axis=-1).reshape(-1, 4)
    v, u = np.meshgrid(
        np.linspace(uv_box[1], uv_box[3], rows), np.linspace(uv_box[0], uv_box[2], columns), indexing="ij"
    )
    uvs = UvSet(values=np.stack([u.ravel(), v.ravel()], axis=1))
    return Solid(points.reshape(-1, 3), np.full(len(quads), 4, np.int32), quads.ravel().astype(np.int32), uvs)


def joined(first: Solid, second: Solid) -> Solid:
    """Two strips (per-point texture coordinates) as one mesh."""
    return Solid(
        np.concatenate([first.points, second.points]),
        np.concatenate([first.counts, second.counts]),
        np.concatenate([first.indices, second.indices + len(first.points)]),
        UvSet(values=np.concatenate([first.uvs.values, second.uvs.values])),
    )
