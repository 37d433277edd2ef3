"""68 landmarks in the Multi-PIE (iBUG) order, and the anchor on the neck."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.parts import Landmarks
from procedural_head import eyes, mouth, topology

# Grid column and level of the jaw's points from the chin (8) to the subject's left ear (16).
_JAW = ((0, 12.85), (5, 12.75), (10, 12.6), (15, 12.35), (19, 12.0), (22, 11.4), (24, 10.5), (25, 9.2), (25, 7.6))
_BROW = ((6, 6.0), (9, 5.77), (12, 5.77), (15, 5.77), (19, 6.0))  # left brow, inner to outer
_BRIDGE = (7.0, 7.5, 8.0, 8.38)  # levels on the midline
_NOSTRILS = ((6, 8.84), (3, 9.02), (0, 9.02))  # left wing to the middle


@cache
def multipie68() -> Landmarks:
    """The landmarks, the same points for every seed."""
    top = topology.build()

    def at(column: float, level: float) -> int:
        row = int(np.abs(topology.row_levels() - level).argmin())
        return int(top.grid[row, int(column)])

    jaw_left = [at(*place) for place in _JAW]
    brow_left = [at(*place) for place in _BROW]
    bridge = [at(0, level) for level in _BRIDGE]
    nostrils = [at(*place) for place in _NOSTRILS]
    jaw = _mirrored(jaw_left[:0:-1], top) + jaw_left
    brows = _mirrored(brow_left[::-1], top) + brow_left
    nose = bridge + _mirrored(nostrils, top) + nostrils[-2::-1]
    indices = jaw + brows + nose + _eyes(top) + _lips(top)
    return Landmarks(indices=np.array(indices, dtype=np.int32))


def anchor() -> int:
    """The point on the neck border in the middle of the back."""
    return int(topology.build().grid[-1, topology.COLUMNS // 2])


def _mirrored(points: list[int], top: topology.Topology) -> list[int]:
    return [int(top.mirror[point]) for point in points]


def _eyes(top: topology.Topology) -> list[int]:
    rim = top.rings["eyeLeft"][eyes.RIM]
    half = len(rim) // 2
    third = half // 3
    # Left eye: inner corner, upper lid outwards, outer corner, lower lid inwards.
    left = [rim[half], rim[half - third], rim[third], rim[0], rim[-third], rim[third - half]]
    right = _mirrored([left[i] for i in (3, 2, 1, 0, 5, 4)], top)
    return right + [int(point) for point in left]


def _lips(top: topology.Topology) -> list[int]:
    outer, inner = top.rings["mouth"][mouth.OUTLINE], top.rings["mouth"][mouth.CONTACT]
    half = len(outer) // 2
    upper = [round(half * share) for share in (1.0, 0.78, 0.62, 0.5, 0.38, 0.22, 0.0)]  # right corner to left
    lower = [-round(half * share) for share in (0.22, 0.38, 0.5, 0.62, 0.78)]  # left to right
    ring = [int(outer[spoke]) for spoke in upper + lower]
    upper = [round(half * share) for share in (1.0, 0.7, 0.5, 0.3, 0.0)]
    lower = [-round(half * share) for share in (0.3, 0.5, 0.7)]
    return ring + [int(inner[spoke]) for spoke in upper + lower]


def indices() -> IntArray:
    """(68,) the points' indices."""
    return multipie68().indices
