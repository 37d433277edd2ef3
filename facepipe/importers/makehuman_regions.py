"""Soft regions of the MakeHuman head, from how strongly the targets of each face part move a point.

Neck targets carry the whole head along, so that their strength says nothing: neck takes the share of a point's skin
weight that lies on joints outside of the head joint's subtree, and the other regions share the rest by the square of
their strength. The cranium, which hardly any target shapes, goes to forehead; the hidden inside of the lids to eyes.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.importers.makehuman_data import MakeHumanData

REGIONS = ("forehead", "eyebrows", "eyes", "nose", "mouth", "cheek", "chin", "ears", "neck")

_WEAK = 0.1  # strength (0..1) that the region of last resort has everywhere


def skin_regions(data: MakeHumanData) -> dict[str, FloatArray]:
    """Masks of the skin points, summing to 1 at each.

    :raises InputError: a region is missing
    """
    skin = data.points_of("skin")
    names = data.names("region_names")
    if set(names) != set(REGIONS):
        raise InputError(f"{data.path} -> region_names", f"are {', '.join(names)}, expected {', '.join(REGIONS)}")
    strength = data["region_strength"][[names.index(name) for name in REGIONS]][:, skin].astype(np.float64)
    neck = _neck_share(data)[skin]
    strength[REGIONS.index("neck")] = 0.0
    _add_last_resort(data["vertices"][skin], strength)
    masks = strength**2
    masks *= (1.0 - neck) / masks.sum(axis=0)
    masks[REGIONS.index("neck")] = neck
    return dict(zip(REGIONS, masks, strict=True))


def _neck_share(data: MakeHumanData) -> FloatArray:
    names = data.names("bone_names")
    if "head" not in names:
        raise InputError(f"{data.path} -> bone_names", "no bone head there")
    in_head = np.zeros(len(names), dtype=bool)
    for bone, parent in enumerate(data["bone_parent"].tolist()):
        in_head[bone] = names[bone] == "head" or (parent >= 0 and in_head[parent])
    share = data["skin_weights"][:, ~in_head].astype(np.float64).sum(axis=1)
    return np.asarray(np.clip(share, 0.0, 1.0))


def _add_last_resort(points: FloatArray, strength: FloatArray) -> None:
    """Raise eyes (where the nearest point that targets shape is one of eyes) or forehead to `_WEAK`, in place."""
    from scipy.spatial import cKDTree

    strong = np.flatnonzero(strength.max(axis=0) >= _WEAK)
    resort = np.full(len(points), REGIONS.index("forehead"))
    if len(strong):
        nearest = strong[cKDTree(points[strong]).query(points)[1]]
        inside = strength.argmax(axis=0)[nearest] == REGIONS.index("eyes")
        resort[inside & (strength.max(axis=0) < _WEAK)] = REGIONS.index("eyes")
    everyone = np.arange(len(points))
    strength[resort, everyone] = np.maximum(strength[resort, everyone], _WEAK)
