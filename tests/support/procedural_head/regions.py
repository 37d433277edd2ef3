"""The nine regions as soft masks that sum to 1 at every point."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from procedural_head import layout, topology

NAMES = ("forehead", "eyebrows", "eyes", "nose", "mouth", "cheek", "chin", "ears", "neck")
_SOFTENING = 6  # steps of averaging over neighbours


@cache
def hard() -> IntArray:
    """(n,) region number of every head point; the forehead takes the cranium."""
    labels = layout.build()
    level = topology.row_levels()[labels.row]
    column = np.abs(labels.column)
    behind = column > 31
    region = np.full(len(level), NAMES.index("forehead"))

    def assign(name: str, inside: BoolArray) -> None:
        region[inside] = NAMES.index(name)

    assign("cheek", (level > 6.3) & (level <= 12.6) & ~behind)
    assign("chin", (level > 11.0) & (level <= 13.7) & (column <= 15))
    assign("neck", (level > 13.2) | (behind & (level > 9.5)))
    assign("chin", (level > 13.0) & (level <= 13.9) & (column <= 13))
    assign("eyebrows", (level > 5.4) & (level <= 6.12) & (column >= 3) & (column <= 21))
    assign("nose", (level > 6.2) & (level <= 9.0) & (column <= np.interp(level, [6.2, 7.5, 8.7], [4, 5, 8])))
    patches = (("mouth", "mouth"), ("eye", "eyes"), ("nostril", "nose"), ("ear", "ears"))
    for patch, name in patches:
        for side in ("", "Left", "Right"):
            if patch + side in labels.ring:
                assign(name, labels.ring[patch + side] >= 1)
    return region.astype(np.int32)


@cache
def soft() -> dict[str, FloatArray]:
    """Region -> (n,) mask over the head."""
    top = topology.build()
    masks = np.eye(len(NAMES))[hard()]
    average = top.averaging()
    for _ in range(_SOFTENING):
        masks = 0.5 * masks + 0.5 * (average @ masks)
    masks[masks < 1e-4] = 0.0
    masks = (masks + masks[top.mirror]) / 2
    masks /= masks.sum(axis=1, keepdims=True)
    return {name: masks[:, i] for i, name in enumerate(NAMES)}


def whole(count: int, name: str) -> dict[str, FloatArray]:
    """Masks of a loose mesh that lies in one region."""
    return {region: np.full(count, float(region == name)) for region in NAMES}


def subsets() -> dict[str, IntArray]:
    """Region -> indices of the head points that are hard in it."""
    return {name: np.nonzero(hard() == i)[0].astype(np.int32) for i, name in enumerate(NAMES)}
