"""Sliders over the joints of the face, for engines that drive faces by bones alone: from -1 to 1, 0 at rest.

`data/bone_sliders.json` has them: group -> slider -> ``joint.channel`` -> gain. A joint's name may end with ``*`` for
the left one and its mirror. Translations are in cm, turns in radians, scales are added to 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib.resources import files

from facepipe.heads.asset import asset
from facepipe.parts import Slider

_MIRRORED = ("tx", "ry", "rz")  # what turns its sign round on the other side


def bone_sliders() -> tuple[Slider, ...]:
    """All of them."""
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
