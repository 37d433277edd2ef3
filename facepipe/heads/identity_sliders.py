"""Sliders of who a head is: a measure each, mixes of several, and what is typical of sex and age.

A slider drives blendshapes and joints: those of the eyes take eyeballs along, and those of the lids open eyes so that a
blink still closes them. At 1 a measure is 2 of its standard deviations above this head's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.directions import MEET, SIDES, Direction, directions
from facepipe.parts import Slider

Gains = Sequence[tuple[Direction, float]]

_LEAST = 1e-3  # cm, or share of the size: less moves no joint
_CHANNELS = (  # joint, channel, column of `Direction.eyes`, and how much of it
    *(("eye", channel, column, 1.0) for column, channel in enumerate(("tx", "ty", "tz", "sx"))),
    *(("eye", channel, 3, 1.0) for channel in ("sy", "sz")),
    *((lid, channel, 4, share) for lid in ("lidUpper", "lidLower") for channel, share in (("ty", MEET), ("sy", 1.0))),
)


def identity_shapes() -> Mapping[str, Mapping[float, FloatArray]]:
    """Name -> weight 1 -> (n, 3) offsets in cm."""
    return {shape.name: {1.0: shape.offsets} for one in directions() for shape in one.shapes}


def identity_sliders() -> tuple[Slider, ...]:
    """All of them, from -1 to 1; those of one side name their mirror."""
    by_name = {one.name: one for one in directions()}
    found = [slider for one in by_name.values() for slider in _family(one.name, one.group, [(one, 1.0)])]
    table = json.loads((files("facepipe.heads") / "data" / "mixes.json").read_text("utf-8"))
    for group, mixes in table.items():  # group -> slider -> gain of each measure
        for name, gains in mixes.items():
            found += _family(name, group, [(by_name[own], gain) for own, gain in gains.items()])
    return tuple(found)


def _family(name: str, group: str, parts: Gains) -> list[Slider]:
    """The slider of both sides and, where all its directions have sides, those of each."""
    whole = [(shape, gain) for one, gain in parts for shape in one.shapes]
    if not all(one.sided for one, _ in parts):
        return [_slider(name, group, whole)]
    sides = [
        _slider(name + side, group, [(one.shapes[i], gain) for one, gain in parts]) for i, side in enumerate(SIDES)
    ]
    mirrors = [replace(one, mirror=other.name) for one, other in (sides, sides[::-1])]
    return [_slider(name, group, whole), *mirrors]


def _slider(name: str, group: str, parts: Gains) -> Slider:
    eyes = sum((gain * shape.eyes for shape, gain in parts), np.zeros((2, 5)))
    channels = [
        (f"root/neck/head/{joint}{side}", channel, round(float(gains[column] * share), 5))
        for side, gains in zip(SIDES, eyes, strict=True)
        for joint, channel, column, share in _CHANNELS
        if abs(gains[column]) >= _LEAST
    ]
    shapes = tuple((shape.name, gain) for shape, gain in parts)
    return Slider(name=name, group=group, minimum=-1.0, channels=tuple(channels), shapes=shapes)
