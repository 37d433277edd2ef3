"""Sliders of who a head is: a measure each, mixes of several, and what is typical of sex and age.

A slider drives blendshapes, and the joints of the eyes, which take the eyeballs along. At 1 a measure is 2 of its
standard deviations above this head's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.directions import SIDES, Direction, directions
from facepipe.parts import Slider

Gains = Sequence[tuple[Direction, float]]

_LEAST = 1e-3  # cm, or share of the size: less does not move an eyeball

_MIXES: dict[str, dict[str, dict[str, float]]] = {  # group -> slider -> measures
    "face": {
        "faceLength": {"chinLength": 0.6, "noseLength": 0.5, "philtrumLength": 0.4, "foreheadHeight": 0.4},
        "faceBreadth": {"faceWidth": 0.7, "cheekboneWidth": 0.5, "jawWidth": 0.6, "foreheadWidth": 0.5},
        "roundFace": {
            "cheekFullness": 0.7,
            "faceWidth": 0.4,
            "jawLineWidth": 0.5,
            "chinLength": -0.5,
            "chinWidth": 0.4,
        },
        "squareFace": {"jawWidth": 0.7, "jawAngleHeight": -0.4, "chinWidth": 0.5, "foreheadWidth": 0.3},
        "heartFace": {"foreheadWidth": 0.5, "cheekboneWidth": 0.4, "jawWidth": -0.5, "chinWidth": -0.6},
        "ovalFace": {"chinLength": 0.3, "jawWidth": -0.4, "foreheadWidth": -0.3, "cheekFullness": 0.2},
        "fullFace": {"cheekFullness": 0.8, "underChin": -0.7, "jawLineWidth": 0.6, "neckWidth": 0.5},
        "gauntFace": {"cheekFullness": -0.8, "cheekboneDepth": 0.4, "cheekboneWidth": 0.3, "jawLineWidth": -0.3},
        "flatFace": {"noseDepth": -0.5, "noseRoot": -0.4, "browDepth": -0.4, "cheekboneDepth": 0.5},
        "childlike": {
            "foreheadRound": 0.5,
            "noseLength": -0.5,
            "chinLength": -0.6,
            "eyeOpening": 0.5,
            "jawWidth": -0.4,
        },
    },
    "head": {
        "craniumSize": {"headLength": 0.5, "headWidth": 0.5, "headHeight": 0.5},
        "longHead": {"headLength": 0.6, "headWidth": -0.6},
        "tallHead": {"headHeight": 0.8, "foreheadHeight": 0.5},
        "highForehead": {"foreheadHeight": 0.8, "foreheadRound": 0.3},
        "thickNeck": {"neckWidth": 0.8, "neckDepth": 0.7},
    },
    "jaw": {
        "strongJaw": {"jawWidth": 0.6, "jawLineWidth": 0.4, "chinDepth": 0.5, "jawAngleHeight": -0.3},
        "strongChin": {"chinDepth": 0.7, "chinWidth": 0.4, "chinLength": 0.4, "chinFold": -0.3},
        "pointedChin": {"chinWidth": -0.8, "chinLength": 0.4},
        "doubleChin": {"underChin": -0.9, "cheekFullness": 0.2},
    },
    "nose": {
        "noseSize": {"noseWidth": 0.5, "noseLength": 0.5, "noseDepth": 0.5, "noseTipWidth": 0.5},
        "aquilineNose": {"noseBridge": 0.9, "noseTipHeight": -0.5, "noseRoot": 0.3},
        "snubNose": {"noseTipHeight": 0.8, "noseBridge": -0.6, "noseLength": -0.4},
        "broadNose": {"noseWidth": 0.7, "nostrilWidth": 0.5, "noseBridgeWidth": 0.5, "noseTipWidth": 0.6},
        "fineNose": {"noseBridgeWidth": -0.6, "noseTipWidth": -0.6, "noseWidth": -0.4},
        "roundNose": {"noseTipWidth": 0.8, "nostrilHeight": 0.3, "noseDepth": 0.3},
    },
    "eyes": {
        "eyeSize": {"eyeWidth": 0.6, "eyeOpening": 0.7},
        "almondEyes": {"eyeTilt": 0.6, "eyeWidth": 0.4, "eyeOpening": -0.3},
        "roundEyes": {"eyeOpening": 0.8, "eyeWidth": -0.3},
        "deepSetEyes": {"eyeDepth": -0.7, "browDepth": 0.4},
        "heavyBrow": {"browDepth": 0.6, "glabella": 0.4, "browHeight": -0.6},
        "archedBrow": {"browHeight": 0.6, "browTilt": 0.5},
    },
    "mouth": {
        "fullLips": {"upperLipFullness": 0.7, "lowerLipFullness": 0.7, "upperLipDepth": 0.3},
        "mouthSize": {"mouthWidth": 0.7, "upperLipFullness": 0.3, "lowerLipFullness": 0.3},
        "pout": {"lowerLipFullness": 0.5, "lowerLipDepth": 0.5, "upperLipDepth": 0.4, "mouthWidth": -0.4},
        "overbite": {"upperLipDepth": 0.5, "lowerLipDepth": -0.4, "chinDepth": -0.4},
        "underbite": {"lowerLipDepth": 0.5, "chinDepth": 0.5, "upperLipDepth": -0.3},
    },
    "ears": {
        "earSize": {"earLength": 0.7, "earWidth": 0.6},
        "proudEars": {"earAngle": 0.9, "earWidth": 0.2},
    },
    "cheeks": {
        "highCheekbones": {"cheekboneHeight": 0.6, "cheekboneDepth": 0.5, "cheekboneWidth": 0.4},
        "fullCheeks": {"cheekFullness": 0.8, "cheekboneDepth": 0.3},
    },
}


def identity_shapes() -> Mapping[str, Mapping[float, FloatArray]]:
    """Name -> weight 1 -> (n, 3) offsets in cm."""
    return {shape.name: {1.0: shape.offsets} for one in directions() for shape in one.shapes}


def identity_sliders() -> tuple[Slider, ...]:
    """All of them, from -1 to 1; those of one side name their mirror."""
    by_name = {one.name: one for one in directions()}
    found = [slider for one in by_name.values() for slider in _family(one.name, one.group, [(one, 1.0)])]
    for group, mixes in _MIXES.items():
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
    eyes = sum((gain * shape.eyes for shape, gain in parts), np.zeros((2, 4)))[:, [0, 1, 2, 3, 3, 3]]
    channels = [
        (f"root/neck/head/eye{side}", channel, round(float(gain), 5))
        for side, gains in zip(SIDES, eyes, strict=True)
        for channel, gain in zip(("tx", "ty", "tz", "sx", "sy", "sz"), gains, strict=True)
        if abs(gain) >= _LEAST
    ]
    shapes = tuple((shape.name, gain) for shape, gain in parts)
    return Slider(name=name, group=group, minimum=-1.0, channels=tuple(channels), shapes=shapes)
