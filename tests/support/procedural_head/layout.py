"""Where every head point lies in the topology, as arrays that skin, shapes and regions share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from procedural_head import topology

CORNER = 0.13  # share of a lip or lid, from its corner, in which the upper and lower side blend


@dataclass(frozen=True)
class Layout:
    """Labels of the head's points; none depends on the seed."""

    row: IntArray  # (n,) grid row; inside a patch the row of its middle; 0 in the cap
    column: IntArray  # (n,) grid column, -39..40; inside a patch that of its middle
    ring: dict[str, IntArray]  # patch -> (n,) ring, -1 elsewhere; the outline is ring 0
    across: dict[str, FloatArray]  # patch -> (n,) 0 at the high-column corner .. 1 at the low-column corner, or nan
    upper: dict[str, FloatArray]  # patch -> (n,) 1 on the upper side, 0 on the lower, blending at the corners; nan


@cache
def build() -> Layout:
    """The labels."""
    top = topology.build()
    row = np.zeros(top.point_count, dtype=np.int32)
    column = np.zeros(top.point_count, dtype=np.int32)
    rows, columns = np.nonzero(top.grid >= 0)
    row[top.grid[rows, columns]] = rows
    half = topology.COLUMNS // 2
    column[top.grid[rows, columns]] = np.where(columns > half, columns - topology.COLUMNS, columns)
    ring: dict[str, IntArray] = {}
    across: dict[str, FloatArray] = {}
    upper: dict[str, FloatArray] = {}
    for name, points in top.rings.items():
        block = topology.BLOCKS[name]
        row[points[1:]] = (block.r0 + block.r1) // 2
        column[points[1:]] = (block.c0 + block.c1) // 2
        ring[name] = np.full(top.point_count, -1, dtype=np.int32)
        ring[name][points] = np.arange(len(points))[:, None]
        across[name] = np.full(top.point_count, np.nan)
        upper[name] = np.full(top.point_count, np.nan)
        share, side = _spokes(points.shape[1])
        across[name][points] = share
        upper[name][points] = side
    return Layout(row, column, ring, across, upper)


def _spokes(spokes: int) -> tuple[FloatArray, FloatArray]:
    half = spokes // 2
    index = np.arange(spokes)
    share = np.where(index <= half, index, spokes - index) / half
    reach = np.clip(np.minimum(share, 1 - share) / CORNER, 0, 1)
    sign = np.where(index <= half, 1.0, -1.0)
    return share, 0.5 + 0.5 * sign * reach * reach * (3 - 2 * reach)


def smoothstep(low: float, high: float, value: FloatArray) -> FloatArray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))
