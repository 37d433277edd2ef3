"""Sliders of who a head is: a measure each, mixes of several, and what is typical of sex and age.

A slider drives blendshapes, and the joints of the eyes, which take the eyeballs along. At 1 a measure is 2 of its
standard deviations above this head's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.directions import SIDES, Direction, directions
from facepipe.parts import Slider

Gains = Sequence[tuple[Direction, float]]

_LEAST = 1e-3  # cm, or share of the size: less does not move an eyeball


def identity_shapes() -> Mapping[str, Mapping[float, FloatArray]]:
    """Name -> weight 1 -> (n, 3) offsets in cm."""
    return {shape.name: {1.0: shape.offsets} for one in directions() for shape in one.shapes}


def identity_sliders() -> tuple[Slider, ...]:
    """All of them, from -1 to 1; those of one side name their mirror."""
    by_name = {one.name: one for one in directions()}
    found = [slider for one in by_name.values() for slider in _family(one.name, one.group, [(one, 1.0)])]
    for group, mixes in _mixes().items():
        for name, gains in mixes.items():
            found += _family(name, group, [(by_name[own], gain) for own, gain in gains.items()])
    return tuple(found)


def _mixes() -> dict[str, dict[str, dict[str, float]]]:
    """Group -> slider -> gain of each measure."""
    return dict(json.loads((files("facepipe.heads") / "data" / "mixes.json").read_text("utf-8")))


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
    eyes = sum((gain * shape.eyes for shape, gain in parts), np.zeros((2, 4)))[:, [0, 1, 2, 3, 3, 3]]
    channels = [
        (f"root/neck/head/eye{side}", channel, round(float(gain), 5))
        for side, gains in zip(SIDES, eyes, strict=True)
        for channel, gain in zip(("tx", "ty", "tz", "sx", "sy", "sz"), gains, strict=True)
        if abs(gain) >= _LEAST
    ]
    shapes = tuple((shape.name, gain) for shape, gain in parts)
    return Slider(name=name, group=group, minimum=-1.0, channels=tuple(channels), shapes=shapes)
