"""Legends of region maps: what a colour means.

A JSON object of colours, ``{"#ff0000": "eyes", "#00ff00": "mouth"}``, several of which may mean one region; or of
regions, ``{"regions": {"eyes": "#ff0000", "mouth": [0, 255, 0]}}``. Beside them, all optional:

- ``"outside"``: the region of points that the map does not cover; without it they keep the regions they have.
- ``"meshes"``: regions of meshes that have no map, whole, like ``{"Eye*": "eyes"}``; names may be globs.
- ``"background"``: a colour that means unpainted, as transparent texels do.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import ByteArray
from facepipe.core.errors import InputError
from facepipe.core.reading import read_json_object

RGB = tuple[int, int, int]

MOST_COLORS = 512
_MOST_BYTES = 1 << 20
_KEYS = ("regions", "outside", "meshes", "background")
_TAKEN = "default"


@dataclass(frozen=True, kw_only=True)
class RegionLegend:
    """What the colours of a map mean.

    :raises InputError: no colours, too many, one twice, the background among them, or a region called ``default``
    """

    colors: tuple[tuple[RGB, str], ...]  # (colour 0..255, region), each colour once
    outside: str | None = None
    meshes: Mapping[str, str] = field(default_factory=dict)  # name or glob -> region
    background: RGB | None = None
    where: str = "legend"  # for messages

    def __post_init__(self) -> None:
        if not 1 <= len(self.colors) <= MOST_COLORS:
            raise InputError(self.where, f"{len(self.colors)} colours, expected 1 to {MOST_COLORS}")
        seen: dict[RGB, str] = {} if self.background is None else {self.background: "the background"}
        for color, name in self.colors:
            if color in seen:
                both = f"{_hex(color)} for {seen[color]} and {name}"
                raise InputError(self.where, f"{both}, expected each colour once")
            seen[color] = name
        if _TAKEN in self.regions:
            raise InputError(
                self.where, f"a region '{_TAKEN}', which means all other regions to a blend, expected another name"
            )

    @property
    def regions(self) -> tuple[str, ...]:
        """Every region that it names, each once: those with colours first."""
        names = [name for _, name in self.colors]
        return tuple(dict.fromkeys([*names, *([self.outside] if self.outside else []), *self.meshes.values()]))

    @property
    def color_array(self) -> ByteArray:
        """(k, 3) its colours."""
        return np.array([color for color, _ in self.colors], dtype=np.uint8).reshape(-1, 3)


def read_legend(path: Path) -> RegionLegend:
    """The legend of a JSON file.

    :raises InputError: not such JSON
    """
    return _legend(str(path), read_json_object(path, _MOST_BYTES))


def _legend(where: str, content: dict[str, object]) -> RegionLegend:
    unknown = [key for key in content if not key.startswith("#") and key not in _KEYS]
    if unknown:
        raise InputError(where, f"key '{unknown[0][:60]}', expected colours like #ff0000, or {', '.join(_KEYS)}")
    named = [(_color(where, key), _name(where, value)) for key, value in content.items() if key.startswith("#")]
    regions = _mapping(where, content, "regions")
    named += [(_color(f"{where} -> {name[:60]}", value), name) for name, value in regions.items()]
    meshes = _mapping(where, content, "meshes")
    return RegionLegend(
        colors=tuple(named),
        outside=_name(where, content["outside"]) if "outside" in content else None,
        meshes={key: _name(f"{where} -> meshes", value) for key, value in meshes.items()},
        background=_color(f"{where} -> background", content["background"]) if "background" in content else None,
        where=where,
    )


def _mapping(where: str, content: dict[str, object], key: str) -> dict[str, object]:
    value = content.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where} -> {key}", f"{str(value)[:40]}, expected an object")
    return value


def _name(where: str, value: object) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(where, f"{str(value)[:40]!r}, expected the name of a region")
    return value


def _color(where: str, value: object) -> RGB:
    if isinstance(value, str) and re.fullmatch(r"#([0-9a-fA-F]{3}|[0-9a-fA-F]{6})", value):
        digits = value[1:] if len(value) == 7 else "".join(digit * 2 for digit in value[1:])
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    if isinstance(value, list) and len(value) == 3 and all(type(one) is int and 0 <= one <= 255 for one in value):
        return value[0], value[1], value[2]
    raise InputError(where, f"colour {str(value)[:40]}, expected one like #ff0000 or [255, 0, 0]")


def _hex(color: RGB) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)
