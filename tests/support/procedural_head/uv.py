"""The head's texture coordinates: a cylindrical unwrap with its seam at the back and the crown as an island above."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import UvSet
from procedural_head import layout, topology

_TOP = 0.78  # of the cylindrical part
_CROWN = (0.4, 0.8, 0.195)  # corner and size of the island


@cache
def head() -> UvSet:
    """Face-varying texture coordinates, the same for every seed."""
    top = topology.build()
    body = _body(top)
    seam = top.grid[:, topology.COLUMNS // 2]
    crown_ids = top.cap.ravel()
    size = topology.CAP
    b, a = np.meshgrid(np.arange(size + 1) / size, np.arange(size + 1) / size, indexing="ij")
    crown = np.stack([_CROWN[0] + _CROWN[2] * a.ravel(), _CROWN[1] + _CROWN[2] * b.ravel()], axis=1)
    values = np.concatenate([body, body[seam] * (0.0, 1.0), crown])
    return UvSet(values=values, indices=_indices(top, seam, crown_ids))


def _indices(top: topology.Topology, seam: IntArray, crown: IntArray) -> IntArray:
    count = top.point_count
    other_side = np.arange(count)
    other_side[seam] = count + np.arange(len(seam))
    on_crown = np.arange(count)
    on_crown[crown] = count + len(seam) + np.arange(len(crown))
    face_of = np.repeat(np.arange(len(top.face_vertex_counts)), top.face_vertex_counts)
    column = layout.build().column[top.face_vertex_indices]
    starts = np.concatenate([[0], np.cumsum(top.face_vertex_counts)[:-1]])
    right = np.minimum.reduceat(column, starts)[face_of] < -topology.COLUMNS // 4
    indices = np.where(right, other_side[top.face_vertex_indices], top.face_vertex_indices)
    crowned = np.isin(face_of, top.cap_faces)
    return np.where(crowned, on_crown[top.face_vertex_indices], indices).astype(np.int32)


def _body(top: topology.Topology) -> FloatArray:
    labels = layout.build()
    levels = topology.row_levels()
    rows = len(levels)
    half = topology.COLUMNS // 2
    # Between even columns and even angles: the face, whose columns are dense, gets more of the texture.
    u = 0.5 + 0.5 * labels.column / half
    v = _TOP * (
        0.5 * (1 - labels.row / (rows - 1)) + 0.5 * (levels[-1] - levels[labels.row]) / (levels[-1] - levels[0])
    )
    values = np.stack([u, v], axis=1)
    for ring in top.rings.values():
        values[ring] = _nested(values[ring[0]], len(ring))
    return values


def _nested(outline: FloatArray, rings: int) -> FloatArray:
    """(rings, spokes, 2) the outline's rectangle shrinking into an ellipse."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle, extent = (low + high) / 2, (high - low) / 2
    turn = 2 * np.pi * np.arange(len(outline)) / len(outline)
    ellipse = extent * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    share = np.linspace(0, 1, rings)[:, None, None]
    round_ = np.clip(share * 2, 0, 1)
    shape = (outline - middle) * (1 - round_) + ellipse * round_
    return np.asarray(middle + shape * (1 - 0.92 * share))
