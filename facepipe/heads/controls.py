"""Sliders of who a head is: of measures, mixes of them and what is typical of sex and age; or over the face's joints.

Sliders of measures drive blendshapes and joints: those of the eyes take eyeballs along, and those of the lids open eyes
so that a blink still closes them. At 1 a measure is 2 of its standard deviations above this head's.
`samples/head/directions.py` found what a measure does: one nose is wider, and nothing else is.

Sliders over joints are for engines that drive faces by bones alone: from -1 to 1, 0 at rest. `data/bone_sliders.json`
has them: group -> slider -> ``joint.channel`` -> gain. A joint's name may end with ``*`` for the left one and its
mirror. Translations are in cm, turns in radians, scales are added to 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import arrays, asset, unpacked
from facepipe.parts import Slider

SIDES = ("Left", "Right")
MEET = 0.433  # cm below the middle of an eye: where lids meet
_MIDDLE = 1.0  # cm on each side of the middle, over which left and right mix


@dataclass(frozen=True, kw_only=True)
class Direction:
    """Two standard deviations of a measure, or what is typical of sex or age."""

    name: str
    group: str
    offsets: npt.NDArray[np.float32]  # (n, 3) cm, symmetric, less what joints do: 0 on the eyeballs
    eyes: FloatArray  # (2, 5) left and right: translation in cm, what is added to its scale, and to that of its lids
    sided: bool  # whether each side has a control of its own

    @cached_property
    def shapes(self) -> tuple[Direction, ...]:
        """What blendshapes are made of: its left and right half, which add up to it, or itself."""
        return (self._half(0), self._half(1)) if self.sided else (self,)

    def _half(self, side: int) -> Direction:
        across = np.clip(asset().points[:, :1] * (1 - 2 * side) / _MIDDLE, -1.0, 1.0)
        share = 0.5 + across * (3.0 - across**2) / 4.0  # a smooth step
        offsets = np.round(self.offsets * share, 3).astype(np.float32)  # as the whole ones are: half the memory
        eyes = self.eyes * (np.arange(2) == side)[:, None]
        return replace(self, name=self.name + SIDES[side], offsets=offsets, eyes=eyes)


@cache
def directions() -> tuple[Direction, ...]:
    """The directions of all measures and traits."""
    data = arrays("measures")
    names = [*data["names"], *data["traits"]]
    groups = [*data["groups"], *("person" for _ in data["traits"])]
    sided = [*data["sided"], *(False for _ in data["traits"])]
    return tuple(
        Direction(name=str(names[i]), group=str(groups[i]), offsets=offsets, eyes=data["eyes"][i], sided=bool(sided[i]))
        for i, offsets in enumerate(unpacked(data["offsets"]))
    )


_MIRRORED = ("tx", "ry", "rz")  # channels of the other sign on the other side


def bone_sliders() -> tuple[Slider, ...]:
    """The sliders over joints."""
    table = json.loads((files("facepipe.heads") / "data" / "bone_sliders.json").read_text("utf-8"))
    paths = {path.rpartition("/")[2]: path for path in asset().joints}
    return tuple(
        Slider(name=name, group=group, minimum=-1.0, channels=tuple(_channels(paths, gains)))
        for group, sliders in table.items()
        for name, gains in sliders.items()
    )


def _channels(paths: Mapping[str, str], gains: Mapping[str, float]) -> Iterator[tuple[str, str, float]]:
    for target, gain in gains.items():
        joint, _, channel = target.partition(".")
        if joint.endswith("*"):
            yield paths[f"{joint[:-1]}Left"], channel, gain
            yield paths[f"{joint[:-1]}Right"], channel, -gain if channel in _MIRRORED else gain
        else:
            yield paths[joint], channel, gain


Gains = Sequence[tuple[Direction, float]]

_LEAST = 1e-3  # cm, or share of the size: less moves no joint
_CHANNELS = (  # joint, channel, column of `Direction.eyes`, and how much of it
    *(("eye", channel, column, 1.0) for column, channel in enumerate(("tx", "ty", "tz", "sx"))),
    *(("eye", channel, 3, 1.0) for channel in ("sy", "sz")),
    *((lid, channel, 4, share) for lid in ("lidUpper", "lidLower") for channel, share in (("ty", MEET), ("sy", 1.0))),
)


def identity_shapes() -> Mapping[str, Mapping[float, FloatArray]]:
    """Name -> weight 1 -> (n, 3) offsets in cm."""
    return {shape.name: {1.0: shape.offsets} for direction in directions() for shape in direction.shapes}


def identity_sliders() -> tuple[Slider, ...]:
    """The sliders of measures, from -1 to 1; those of one side name their mirror."""
    by_name = {direction.name: direction for direction in directions()}
    sliders = [slider for one in by_name.values() for slider in _family(one.name, one.group, [(one, 1.0)])]
    table = json.loads((files("facepipe.heads") / "data" / "mixes.json").read_text("utf-8"))
    for group, mixes in table.items():  # group -> slider -> gain of each measure
        for name, gains in mixes.items():
            sliders += _family(name, group, [(by_name[measure], gain) for measure, gain in gains.items()])
    return tuple(sliders)


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
