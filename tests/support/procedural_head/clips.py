"""Animations of the sample: two poses and a short clip."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation
from procedural_head.rig import HEAD, JAW, Rig

TALK = "talk"
_RATE = 24


def build(rig: Rig) -> tuple[Animation, ...]:
    """The poses `smile` and `lookLeft` and the clip `talk` (1 s at 24 fps), rotations about X, Y, Z in radians."""
    smile = {
        "mouthSmileLeft": 0.9,
        "mouthSmileRight": 0.9,
        "cheekSquintLeft": 0.5,
        "cheekSquintRight": 0.5,
        "jawOpen": 0.08,
    }
    look = {"eyeLookOutLeft": 0.4, "eyeLookInRight": 0.4}
    turned = {"root/neck": (0.0, 0.12, 0.0), HEAD: (0.05, 0.25, 0.0)}
    return (
        _animation("smile", rig, None, {key: np.array([value]) for key, value in smile.items()}, {}),
        _animation(
            "lookLeft",
            rig,
            None,
            {k: np.array([v]) for k, v in look.items()},
            {k: np.array([v]) for k, v in turned.items()},
        ),
        _talk(rig),
    )


def _talk(rig: Rig) -> Animation:
    times = np.arange(_RATE + 1) / _RATE
    beat = 0.5 - 0.5 * np.cos(2 * np.pi * 3 * times)  # three syllables a second
    slow = np.sin(2 * np.pi * times)
    shapes = {
        "jawOpen": 0.12 * beat,
        "mouthFunnel": 0.5 * beat * (times > 1 / 3) * (times <= 2 / 3),
        "mouthStretchLeft": 0.25 * beat * (times <= 1 / 3),
        "mouthStretchRight": 0.25 * beat * (times <= 1 / 3),
        "mouthLowerDownLeft": 0.35 * beat,
        "mouthLowerDownRight": 0.35 * beat,
        "browInnerUp": 0.4 * np.maximum(slow, 0.0),
        "eyeBlinkLeft": np.exp(-(((times - 0.75) / 0.06) ** 2)),
        "eyeBlinkRight": np.exp(-(((times - 0.75) / 0.06) ** 2)),
    }
    zero = np.zeros_like(times)
    turns = {
        HEAD: np.stack([0.04 * slow, 0.06 * slow, zero], axis=1),
        JAW: np.stack([0.10 * beat, zero, zero], axis=1),
    }
    return _animation(TALK, rig, times, shapes, turns)


def _animation(
    name: str, rig: Rig, times: FloatArray | None, shapes: Mapping[str, FloatArray], turns: Mapping[str, FloatArray]
) -> Animation:
    samples = 1 if times is None else len(times)
    joints = tuple(joint for joint in rig.skeleton.joints if joint in turns)
    rest = rig.skeleton.rest_transforms[[rig.index(joint) for joint in joints]]
    angles = np.stack([turns[joint] for joint in joints], axis=1) if joints else np.zeros((samples, 0, 3))
    return Animation(
        name=name,
        times=times,
        joints=joints,
        translations=np.tile(rest[:, :3, 3], (samples, 1, 1)),
        rotations=_quaternions(angles),
        scales=np.ones((samples, len(joints), 3)),
        shapes=tuple(shapes),
        shape_weights=np.stack(list(shapes.values()), axis=1),
    )


def _quaternions(angles: FloatArray) -> FloatArray:
    """(..., 4) quaternions x y z w of Rz Rx Ry for (..., 3) angles about X, Y, Z."""
    half = angles / 2
    sx, sy, sz = np.moveaxis(np.sin(half), -1, 0)
    cx, cy, cz = np.moveaxis(np.cos(half), -1, 0)
    return np.stack(
        [
            cz * sx * cy - sz * cx * sy,
            cz * cx * sy + sz * sx * cy,
            cz * sx * sy + sz * cx * cy,
            cz * cx * cy - sz * sx * sy,
        ],
        axis=-1,
    )
