"""Weights as JSON: in files of users and in recipes.

``{"regions": {"eyes": [0.8, 0.2]}, "default": [0.5, 0.5], "gains": [1, 0.5], "locked": {"mouth": 2}}``, each key
optional; or flat, the regions beside the other keys: ``{"eyes": [0.8, 0.2], "default": [0.5, 0.5]}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object
from facepipe.processors.blend.weights import Weights

_MOST_BYTES = 1 << 20
_KEYS = ("regions", "default", "gains", "locked")


def read_weights(path: Path) -> Weights:
    """The weights of a JSON file; names and counts are checked against the faces later.

    :raises InputError: not such JSON
    """
    return weights_from_json(read_json_object(path, _MOST_BYTES), str(path))


def weights_to_json(weights: Weights) -> dict[str, Any]:
    """The weights as `weights_from_json` reads them."""
    return {
        "regions": {name: [float(one) for one in weights.regions[name]] for name in sorted(weights.regions)},
        "default": None if weights.default is None else [float(one) for one in weights.default],
        "gains": None if weights.gains is None else [float(one) for one in weights.gains],
        "locked": {name: int(weights.locked[name]) for name in sorted(weights.locked)},
    }


def weights_from_json(content: object, where: str) -> Weights:
    """The weights of parsed JSON.

    :raises InputError: another structure, or values of other types
    """
    content = _mapping(content, where)
    nested = isinstance(content.get("regions"), Mapping)
    others = {key: value for key, value in content.items() if key not in (_KEYS if nested else _KEYS[1:])}
    if nested and others:
        raise InputError(f"{where} -> {next(iter(others))[:60]}", f"unknown key, expected some of {', '.join(_KEYS)}")
    regions = _mapping(content["regions"], f"{where} -> regions") if nested else others
    locked = _mapping(content.get("locked") or {}, f"{where} -> locked")
    return Weights(
        regions={name: _numbers(row, f"{where} -> {name[:60]}") for name, row in regions.items()},
        default=_optional(content.get("default"), f"{where} -> default"),
        gains=_optional(content.get("gains"), f"{where} -> gains"),
        locked={name: _source(number, f"{where} -> locked -> {name[:60]}") for name, number in locked.items()},
    )


def _mapping(value: object, where: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise InputError(where, f"{str(value)[:40]}, expected a JSON object")
    return value


def _optional(value: object, where: str) -> tuple[float, ...] | None:
    return None if value is None else _numbers(value, where)


def _numbers(value: object, where: str) -> tuple[float, ...]:
    good = isinstance(value, list | tuple) and value
    if not good or any(type(one) not in (int, float) or abs(one) > 1e300 for one in value):  # type: ignore[attr-defined]
        raise InputError(where, f"{str(value)[:40]}, expected a list of numbers, one per source")
    return tuple(float(one) for one in value)  # type: ignore[attr-defined]


def _source(value: object, where: str) -> int:
    if type(value) is not int or not 1 <= value <= 1_000_000:
        raise InputError(where, f"{str(value)[:40]}, expected the number of a source, from 1")
    return value
