"""`VRMC_vrm.lookAt`: where the eyes are, and what turns them how far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe_gltf.placement import numbers
from facepipe_gltf.vrm.expressions import Expressions, table
from facepipe_gltf.vrm.nodes import NodeTree

Json = dict[str, Any]

_FIELDS = {
    "rangeMapHorizontalInner": "inner",
    "rangeMapHorizontalOuter": "outer",
    "rangeMapVerticalDown": "down",
    "rangeMapVerticalUp": "up",
}


def look_at(tree: NodeTree, bones: Mapping[str, int], eyes: FloatArray, kind: Literal["bone", "expression"]) -> Json:
    """Bones turn by the angle of what is looked at, up to a limit; shapes are fully on at the same angle.

    :param eyes: (2, 3) left and right
    """
    between = np.linalg.inv(tree.world(bones["head"])) @ [*eyes.mean(axis=0), 1.0]
    limits = {field: table()["degrees"][kind][name] for field, name in _FIELDS.items()}
    ranges = {
        field: {"inputMaxValue": limit, "outputScale": limit if kind == "bone" else 1.0}
        for field, limit in limits.items()
    }
    return {"type": kind, "offsetFromHeadBone": numbers(between[:3])} | ranges


def looks_by_shapes(expressions: Expressions) -> bool:
    """Whether shapes look in all directions."""
    return expressions.has("lookUp", "lookDown", "lookLeft", "lookRight")
