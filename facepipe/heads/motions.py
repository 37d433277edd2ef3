"""Two poses and a clip: a smile, a look to the side, and a second of talk."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.expressing import VISEMES, sided
from facepipe.parts import Animation
from facepipe.rig.bone_coefficients import CHANNELS, rest_coefficients

TALK = "talk"
_RATE = 24
_SAID = ("sil", "DD", "E", "FF", "aa", "SS", "O", "PP", "U", "sil")  # over a second, each passing into the next
_HEAD, _NECK = "root/neck/head", "root/neck"
_EYES = (f"{_HEAD}/eyeLeft", f"{_HEAD}/eyeRight")

Tracks = Mapping[str, FloatArray | float]


def animations(shapes: frozenset[str]) -> tuple[Animation, ...]:
    """`smile`, `lookLeft` and `talk` of a head that has the shapes of ARKit."""
    smile = sided({"mouthSmile": 0.9, "cheekSquint": 0.5, "jawOpen": 0.05}, shapes)
    look = {"eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7}
    turns = {f"{_NECK}.ry": 0.12, f"{_HEAD}.rx": 0.05, f"{_HEAD}.ry": 0.25} | {f"{eye}.ry": 0.35 for eye in _EYES}
    return (_animation("smile", None, smile, {}), _animation("lookLeft", None, look, turns), _talk(shapes))


def _talk(shapes: frozenset[str]) -> Animation:
    times = np.arange(_RATE + 1) / _RATE
    beats = np.abs(times[:, None] * (len(_SAID) - 1) - np.arange(len(_SAID)))
    shares = 0.5 + 0.5 * np.cos(np.pi * np.minimum(beats, 1.0))  # (times, said), in sum 1
    found: dict[str, FloatArray] = {}
    for share, viseme in zip(shares.T, _SAID, strict=True):
        for shape, weight in sided(VISEMES[viseme], shapes).items():
            found[shape] = found.get(shape, np.zeros(len(times))) + weight * share
    slow = np.sin(2 * np.pi * times)
    blink = np.exp(-(((times - 0.75) / 0.06) ** 2))
    found |= {"eyeBlinkLeft": blink, "eyeBlinkRight": blink, "browInnerUp": 0.4 * np.maximum(slow, 0.0)}
    return _animation(TALK, times, found, {f"{_HEAD}.rx": 0.04 * slow, f"{_HEAD}.ry": 0.06 * slow})


def _animation(name: str, times: FloatArray | None, shapes: Tracks, turns: Tracks) -> Animation:
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
