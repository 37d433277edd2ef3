"""Expressions of the head, all over shapes of ARKit.

Sliders of moods, of where the eyes look, and of the fifteen visemes of Oculus; two poses, a smile and a look to the
side, and a clip, a second of talk.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, Slider
from facepipe.rig.bone_coefficients import CHANNELS, rest_coefficients

_TURN = 0.5  # radians that an eye turns to the side, and up or down, at 1
_LEFT, _RIGHT = "root/neck/head/eyeLeft", "root/neck/head/eyeRight"
_RISING = ((-1.0, 0.0), (0.0, 0.0), (1.0, 1.0))
_FALLING = ((-1.0, 1.0), (0.0, 0.0), (1.0, 0.0))
_BOTH = ("Left", "Right")

_MOODS: dict[str, dict[str, float]] = {
    "smile": {"mouthSmile": 1.0, "cheekSquint": 0.5},
    "frown": {"mouthFrown": 1.0, "browInnerUp": 0.5},
    "blink": {"eyeBlink": 1.0},
    "mouthOpen": {"jawOpen": 1.0},
}
VISEMES: dict[str, dict[str, float]] = {
    "sil": {"mouthPress": 0.05},
    "PP": {"mouthPress": 0.5, "mouthRollLower": 0.3, "mouthRollUpper": 0.25, "mouthPucker": 0.1},
    "FF": {"jawOpen": 0.04, "mouthRollLower": 0.55, "mouthUpperUp": 0.3, "mouthShrugLower": 0.15},
    "TH": {"tongueOut": 0.72, "mouthLowerDown": 0.15, "mouthUpperUp": 0.1},
    "DD": {"jawOpen": 0.12, "mouthLowerDown": 0.3, "mouthUpperUp": 0.15},
    "kk": {"jawOpen": 0.2, "mouthStretch": 0.15, "mouthLowerDown": 0.15},
    "CH": {"jawOpen": 0.07, "mouthFunnel": 0.7, "mouthPucker": 0.2, "mouthShrugUpper": 0.15},
    "SS": {"jawOpen": 0.03, "mouthStretch": 0.35, "mouthSmile": 0.15, "mouthLowerDown": 0.4, "mouthUpperUp": 0.2},
    "nn": {"jawOpen": 0.09, "mouthLowerDown": 0.25, "mouthUpperUp": 0.1},
    "RR": {"jawOpen": 0.1, "mouthFunnel": 0.45, "mouthPucker": 0.2},
    "aa": {"jawOpen": 0.55, "mouthStretch": 0.1, "mouthLowerDown": 0.2},
    "E": {"jawOpen": 0.22, "mouthStretch": 0.35, "mouthSmile": 0.2, "mouthLowerDown": 0.2, "mouthUpperUp": 0.1},
    "I": {"jawOpen": 0.12, "mouthSmile": 0.5, "mouthStretch": 0.25, "mouthLowerDown": 0.25},
    "O": {"jawOpen": 0.4, "mouthFunnel": 0.7, "mouthPucker": 0.15},
    "U": {"jawOpen": 0.12, "mouthPucker": 0.75, "mouthFunnel": 0.45},
}


def sided(weights: dict[str, float], shapes: frozenset[str]) -> dict[str, float]:
    """The weights with those of both sides for names that shapes have by sides alone."""
    return {
        shape: weight
        for name, weight in weights.items()
        for shape in ((name,) if name in shapes else (name + side for side in _BOTH))
    }


def sliders(shapes: frozenset[str]) -> tuple[Slider, ...]:
    """The sliders of a head that has the shapes of ARKit."""
    made = [
        Slider(name=prefix + name, group=group, shapes=tuple(sided(weights, shapes).items()))
        for group, prefix, table in (("expression", "", _MOODS), ("visemes", "viseme_", VISEMES))
        for name, weights in table.items()
    ]
    return (
        *made,
        _look("lookLeft", "ry", ("eyeLookOutLeft", "eyeLookInRight"), ("eyeLookInLeft", "eyeLookOutRight")),
        _look("lookDown", "rx", ("eyeLookDownLeft", "eyeLookDownRight"), ("eyeLookUpLeft", "eyeLookUpRight")),
    )


def _look(name: str, channel: str, forth: tuple[str, ...], back: tuple[str, ...]) -> Slider:
    """Turns both eyes, and has the lids follow them either way."""
    return Slider(
        name=name,
        group="eyes",
        minimum=-1.0,
        channels=((_LEFT, channel, _TURN), (_RIGHT, channel, _TURN)),
        channel_curves=(None, None),
        shapes=tuple((shape, 1.0) for shape in (*forth, *back)),
        shape_curves=(_RISING,) * len(forth) + (_FALLING,) * len(back),
    )


TALK = "talk"
_RATE = 24
_SPOKEN = ("sil", "DD", "E", "FF", "aa", "SS", "O", "PP", "U", "sil")  # over a second, each passing into the next
_HEAD, _NECK = "root/neck/head", "root/neck"
_EYES = (f"{_HEAD}/eyeLeft", f"{_HEAD}/eyeRight")

_Tracks = Mapping[str, FloatArray | float]


def animations(shapes: frozenset[str]) -> tuple[Animation, ...]:
    """`smile`, `lookLeft` and `talk` of a head that has the shapes of ARKit."""
    smile = sided({"mouthSmile": 0.9, "cheekSquint": 0.5, "jawOpen": 0.05}, shapes)
    look = {"eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7}
    turns = {f"{_NECK}.ry": 0.12, f"{_HEAD}.rx": 0.05, f"{_HEAD}.ry": 0.25} | {f"{eye}.ry": 0.35 for eye in _EYES}
    return (_animation("smile", None, smile, {}), _animation("lookLeft", None, look, turns), _talk(shapes))


def _talk(shapes: frozenset[str]) -> Animation:
    times = np.arange(_RATE + 1) / _RATE
    beats = np.abs(times[:, None] * (len(_SPOKEN) - 1) - np.arange(len(_SPOKEN)))
    shares = 0.5 + 0.5 * np.cos(np.pi * np.minimum(beats, 1.0))  # (times, spoken), in sum 1
    weights: dict[str, FloatArray] = {}
    for share, viseme in zip(shares.T, _SPOKEN, strict=True):
        for shape, weight in sided(VISEMES[viseme], shapes).items():
            weights[shape] = weights.get(shape, np.zeros(len(times))) + weight * share
    slow = np.sin(2 * np.pi * times)
    blink = np.exp(-(((times - 0.75) / 0.06) ** 2))
    weights |= {"eyeBlinkLeft": blink, "eyeBlinkRight": blink, "browInnerUp": 0.4 * np.maximum(slow, 0.0)}
    return _animation(TALK, times, weights, {f"{_HEAD}.rx": 0.04 * slow, f"{_HEAD}.ry": 0.06 * slow})


def _animation(name: str, times: FloatArray | None, shapes: _Tracks, turns: _Tracks) -> Animation:
    """:param turns: joint path and channel -> radians"""
    samples = 1 if times is None else len(times)
    joints = tuple(sorted({key.rpartition(".")[0] for key in turns}, key=lambda path: path.split("/")))
    coefficients = np.tile(rest_coefficients(len(joints)), (samples, 1, 1))
    for key, values in turns.items():
        joint, _, channel = key.rpartition(".")
        coefficients[:, joints.index(joint), CHANNELS.index(channel)] = values
    weights = [np.broadcast_to(values, samples) for values in shapes.values()]
    return Animation(
        name=name,
        times=times,
        joints=joints,
        coefficients=coefficients,
        shapes=tuple(shapes),
        shape_weights=np.stack(weights, axis=1),
    )
