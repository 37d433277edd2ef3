"""How sliders were made from blendshapes, as the options of a recipe."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from facepipe.core.errors import SchemaError
from facepipe.declare import from_json, json_value
from facepipe.processors.fit_bones.limits import limits_from_json
from facepipe.processors.sliders.from_shapes import SlidersFromShapes
from facepipe.processors.sliders.shape_options import ShapeSliderOptions

_KEYS = {"shapes", "drop", "limits", "options"}


def maker_to_json(maker: SlidersFromShapes) -> dict[str, Any]:
    """Its options as JSON holds them."""
    fields = dataclasses.fields(ShapeSliderOptions)
    return {
        "shapes": maker.shapes,
        "drop": maker.drop,
        "limits": maker.limits.to_json(),
        "options": {one.name: json_value(getattr(maker, one.name)) for one in fields},
    }


def maker_from_json(where: str, content: Mapping[str, object]) -> SlidersFromShapes:
    """What `maker_to_json` made JSON of.

    :raises InputError: options that are unknown, of another type or out of range
    :raises SchemaError: damaged content
    """
    shapes, drop = content.get("shapes"), content.get("drop")
    if set(content) != _KEYS or not isinstance(shapes, str) or not isinstance(drop, bool):
        raise SchemaError(where, f"options are damaged, expected an object of {', '.join(sorted(_KEYS))}")
    options = from_json(ShapeSliderOptions, content["options"], f"{where} -> options")
    limits = limits_from_json(content["limits"], f"{where} -> limits")
    return SlidersFromShapes(shapes=shapes, drop=drop, limits=limits, **dataclasses.asdict(options))
