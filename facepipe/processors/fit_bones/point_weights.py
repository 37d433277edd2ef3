"""How much each point counts in a fit: by regions, and by what is masked out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.parts import FaceParts, all_regions

LARGEST_WEIGHT = 1e12

_NONE = "none, the face has neither regions nor point subsets"


def point_weights(parts: FaceParts, regions: Mapping[str, float], mask: Sequence[str]) -> FloatArray:
    """(n,) weights of all points.

    :param regions: region or point subset -> factor, 0 or more; where a mask is soft, or in none, the rest counts as 1
    :param mask: regions or point subsets outside which nothing counts; empty: all counts
    :raises InputError: unknown names, factors that are negative or not finite, or no point that counts
    """
    known = _masks(parts)
    count = sum(len(mesh.points) for mesh in parts.meshes)
    weights = np.ones(count)
    for name, factor in sorted(regions.items()):  # sums depend on the order, which a recipe does not keep
        where = f"region {name}"
        if not (isinstance(factor, int | float) and math.isfinite(factor) and 0 <= factor <= LARGEST_WEIGHT):
            raise InputError(where, f"weight {factor}, expected a number from 0 to {LARGEST_WEIGHT:g}")
        weights += _mask(known, name, where) * (factor - 1.0)
    weights = np.maximum(weights, 0.0)
    if mask:
        weights *= np.clip(sum(_mask(known, name, f"mask {name}") for name in mask), 0.0, 1.0)
    weights[weights < 1e-6 * weights.max(initial=0.0)] = 0.0  # what rounding of masks leaves of 0
    if not weights.any():
        raise InputError("weights", "all points weigh 0, expected some that count")
    return weights


def _masks(parts: FaceParts) -> dict[str, FloatArray]:
    """Region or point subset -> (n,) mask 0..1; of a name that both have the region."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    found: dict[str, FloatArray] = {}
    for mesh, start in zip(parts.meshes, starts, strict=False):
        for name, indices in mesh.point_subsets.items():
            found.setdefault(name, np.zeros(starts[-1]))[np.asarray(indices, dtype=np.int64) + start] = 1.0
    regions = {
        name: np.clip(np.asarray(mask, np.float64), 0.0, 1.0) for name, mask in all_regions(parts.meshes).items()
    }
    return {**found, **regions}


def _mask(known: Mapping[str, FloatArray], name: str, where: str) -> FloatArray:
    if name not in known:
        raise InputError(where, f"no such region or point subset{suggestion(name, sorted(known), _NONE)}")
    return known[name]
