"""Sliders over the joints of the face, for engines that drive faces by bones alone: from -1 to 1, 0 at rest.

A joint's name may end with ``*`` for the left one and its mirror. Translations are in cm, turns in radians, scales are
added to 1.
"""

from __future__ import annotations

from collections.abc import Iterator

from facepipe.heads.asset import asset
from facepipe.parts import Slider

_MIRRORED = ("tx", "ry", "rz")  # what turns its sign round on the other side
_EYE = ("eye*", "lidUpper*", "lidLower*")
_BROW = ("browInner*", "browMid*", "browOuter*")
_LIPS = ("lipUpper", "lipUpper*", "lipLower", "lipLower*", "lipCorner*")
_SIZE = ("sx", "sy", "sz")

Rows = tuple[tuple[tuple[str, ...], tuple[str, ...], float], ...]  # joints, channels, gain

_SLIDERS: dict[str, dict[str, Rows]] = {
    "nose": {
        "noseWidth": ((("nostril*",), ("tx",), 0.5),),
        "noseLength": ((("noseTip",), ("ty",), -0.5), (("nostril*",), ("ty",), -0.4)),
        "noseDepth": ((("noseTip",), ("tz",), 0.6),),
        "noseBridge": ((("noseBridge",), ("tz",), 0.5),),
        "noseBridgeWidth": ((("noseBridge",), ("sx",), 0.25),),
        "noseTipTilt": ((("noseTip",), ("rx",), -0.3),),
        "noseTipSize": ((("noseTip",), _SIZE, 0.25),),
        "noseSize": ((("nose",), _SIZE, 0.12),),
        "nostrilHeight": ((("nostril*",), ("ty",), 0.35),),
    },
    "jaw": {
        "jawWidth": ((("jowl*",), ("tx",), 0.8), (("cheekLower*",), ("tx",), 0.4)),
        "jawAngle": ((("jowl*",), ("ty",), 0.7),),
        "jawForward": ((("jaw",), ("tz",), 0.4),),
        "chinLength": ((("chin",), ("ty",), -0.8),),
        "chinDepth": ((("chin",), ("tz",), 0.8),),
        "chinWidth": ((("chin",), ("sx",), 0.3),),
    },
    "eyes": {
        "eyeSize": ((_EYE, _SIZE, 0.08),),
        "eyeSpacing": ((_EYE, ("tx",), 0.18),),
        "eyeHeight": ((_EYE, ("ty",), 0.25),),
        "eyeDepth": ((_EYE, ("tz",), 0.25),),
        "eyeTilt": ((_EYE[1:], ("rz",), 0.12),),
        "eyeOpening": ((("lidUpper*",), ("rx",), -0.12), (("lidLower*",), ("rx",), 0.05)),
    },
    "brows": {
        "browHeight": ((_BROW, ("ty",), 0.6),),
        "browDepth": ((_BROW, ("tz",), 0.5),),
        "browTilt": ((("browInner*",), ("ty",), -0.4), (("browOuter*",), ("ty",), 0.5)),
        "browSpacing": ((("browInner*",), ("tx",), 0.4),),
        "browArch": ((("browMid*",), ("ty",), 0.5),),
    },
    "cheeks": {
        "cheekbones": ((("cheekUpper*",), ("tx", "tz"), 0.4),),
        "cheekHeight": ((("cheekUpper*",), ("ty",), 0.6),),
        "cheekFullness": ((("cheekLower*",), ("tx", "tz"), 0.4),),
    },
    "mouth": {
        "mouthWidth": ((("lipCorner*",), ("tx",), 0.6),),
        "mouthHeight": ((_LIPS, ("ty",), 0.3),),
        "mouthDepth": ((_LIPS, ("tz",), 0.3),),
        "mouthCorner": ((("lipCorner*",), ("ty",), 0.4),),
        "upperLipFullness": ((("lipUpper", "lipUpper*"), ("tz",), 0.2),),
        "lowerLipFullness": ((("lipLower", "lipLower*"), ("tz",), 0.25),),
    },
    "ears": {
        "earSize": ((("ear*",), _SIZE, 0.15),),
        "earAngle": ((("ear*",), ("ry",), 0.3),),
        "earHeight": ((("ear*",), ("ty",), 0.5),),
        "earTilt": ((("ear*",), ("rx",), 0.25),),
    },
    "head": {"headSize": ((("head",), _SIZE, 0.08),)},
    "forehead": {
        "foreheadDepth": ((("forehead",), ("tz",), 0.4),),
        "foreheadHeight": ((("forehead",), ("ty",), 0.8),),
        "templeWidth": ((("temple*",), ("tx",), 0.4),),
    },
}


def bone_sliders() -> tuple[Slider, ...]:
    """All of them."""
    paths = {path.rpartition("/")[2]: path for path in asset().joints}
    return tuple(
        Slider(name=name, group=group, minimum=-1.0, channels=tuple(_channels(paths, rows)))
        for group, sliders in _SLIDERS.items()
        for name, rows in sliders.items()
    )


def _channels(paths: dict[str, str], rows: Rows) -> Iterator[tuple[str, str, float]]:
    for joints, channels, gain in rows:
        for joint in joints:
            for channel in channels:
                if joint.endswith("*"):
                    mirrored = -gain if channel in _MIRRORED else gain
                    yield paths[f"{joint[:-1]}Left"], channel, gain
                    yield paths[f"{joint[:-1]}Right"], channel, mirrored
                else:
                    yield paths[joint], channel, gain
