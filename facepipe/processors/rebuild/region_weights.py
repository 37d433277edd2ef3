"""How far each point of a face may follow, by the regions that were asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.parts import FaceParts, all_regions

_NO_REGIONS = ", expected a face with regions (facepipe regions)"


def region_weights(parts: FaceParts, names: Sequence[str], where: str) -> FloatArray:
    """(n,) 0 to 1 for whole points: the sum of the soft masks of the regions `names`, 1 all over where none is named.

    :raises InputError: a region that the face has not, with the names of those that it has
    """
    if not names:
        return np.ones(sum(len(mesh.points) for mesh in parts.meshes))
    regions = all_regions(parts.meshes)
    for name in names:
        if name not in regions:
            raise InputError(
                f"{where} -> region {name[:60]}",
                f"no such region{suggestion(name, regions) if regions else _NO_REGIONS}",
            )
    masks = np.stack([regions[name] for name in dict.fromkeys(names)]).astype(np.float64)
    if not (np.isfinite(masks).all() and masks.max(initial=0.0) > 0.0):
        raise InputError(f"{where} -> region {', '.join(names)}", "no point is in it, expected some")
    return np.asarray(np.clip(masks.sum(axis=0), 0.0, 1.0))
