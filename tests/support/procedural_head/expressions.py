"""The head's expressions as offset fields, for the subject's left side where a shape has sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head.fields import HINGE, Fields

Expression = Callable[[Fields], FloatArray]
JAW_OPEN = np.radians(14.0)
_MEETING = 0.2  # where the lips of an open jaw meet, from the upper (0) to the lower (1)


def _push(mask: FloatArray, direction: tuple[float, float, float]) -> FloatArray:
    return np.asarray(mask[:, None] * np.array(direction))


def open_jaw(points: FloatArray, share: FloatArray) -> FloatArray:
    """(n, 3) offsets of points that follow a fully opened jaw by `share` (n,)."""
    offset = points - HINGE
    sine, cosine = np.sin(JAW_OPEN), np.cos(JAW_OPEN)
    turned = np.stack(
        [offset[:, 0], cosine * offset[:, 1] - sine * offset[:, 2], sine * offset[:, 1] + cosine * offset[:, 2]], axis=1
    )
    return np.asarray(share[:, None] * (turned - offset))


def _corner(f: Fields, rx: float = 1.5, ry: float = 1.4) -> FloatArray:
    """Around the left corner of the mouth, as far inside as the lips reach."""
    return f.spot((f.lips.half_width, f.lips.height), (rx, ry)) * f.follow


def _near_mouth(f: Fields, rx: float = 3.2, ry: float = 2.2) -> FloatArray:
    return f.spot((0.0, f.lips.height), (rx, ry)) * f.follow


def _lip_part(f: Fields, *, upper: bool, ry: float = 1.1) -> FloatArray:
    """The left half of one lip and the skin around it."""
    side = 1.0 if upper else -1.0
    around = f.spot((1.15, f.lips.height + 0.55 * side), (1.15, ry)) * f.follow
    return np.asarray(around * (f.upper if upper else 1 - f.upper))


def mouth_close(f: Fields) -> FloatArray:
    """Closes the lips of an open jaw: the lower lip comes up, the upper lip, held by the teeth, down a little."""
    opened = open_jaw(f.points, f.jaw)
    lower_lip = open_jaw(f.points, np.ones(len(f.points)))
    return np.asarray(f.lip[:, None] * (_MEETING * lower_lip - opened))


def _smile(f: Fields) -> FloatArray:
    cheek = f.spot((4.0, -3.7), (1.6, 1.4)) * f.skin
    return _push(_corner(f, 1.9, 1.6), (0.62, 0.72, -0.42)) + _push(cheek, (0.16, 0.34, 0.26))


def _roll(f: Fields, *, upper: bool) -> FloatArray:
    side = f.upper if upper else 1 - f.upper
    mask = f.lip * side * f.spot((0.0, f.lips.height), (2.4, 1.6))
    toward = f.lips.line(f.points[:, 0]) - f.points[:, 1]
    toward = np.clip(toward, -1.0, 1.0) * 0.5
    return np.stack([0 * mask, mask * toward, -0.42 * mask], axis=1)


def _press(f: Fields) -> FloatArray:
    mask = f.lip * f.spot((1.2, f.lips.height), (1.3, 1.2))
    toward = np.clip(f.lips.line(f.points[:, 0]) - f.points[:, 1], -1.0, 1.0)
    return np.stack([0.05 * mask, 0.35 * mask * toward, -0.14 * mask], axis=1)


def _gather(f: Fields, narrow: float, forward: float, part: float) -> FloatArray:
    """Lips drawn to the middle and forward, parted by `part` on each side."""
    mask = _near_mouth(f, 2.9, 1.9)
    x = f.points[:, 0]
    apart = f.lip * (2 * f.upper - 1) * np.exp(-((x / 2.2) ** 2))
    return np.stack([-narrow * mask * x, part * apart, forward * mask * np.exp(-((x / 2.6) ** 2))], axis=1)


def _shrug_lower(f: Fields) -> FloatArray:
    chin = f.spot((0.0, -9.0), (1.8, 1.6)) * f.skin
    lips = _near_mouth(f, 2.2, 1.0)
    return _push(np.maximum(chin * 0.9, lips), (0.0, 0.34, 0.12)) + _push(f.lip * (1 - f.upper) * lips, (0.0, 0.0, 0.2))


def _puff(f: Fields) -> FloatArray:
    mask = (f.spot((4.1, -6.0), (1.8, 1.9)) + f.spot((-4.1, -6.0), (1.8, 1.9))) * f.skin * (1 - f.lip)
    return mask[:, None] * np.stack([0.75 * np.sign(f.points[:, 0]), 0 * mask, 0.55 + 0 * mask], axis=1)


def _brow_inner(f: Fields) -> FloatArray:
    return _push(f.spot((1.5, 2.2), (1.3, 1.3)) + f.spot((-1.5, 2.2), (1.3, 1.3)), (0.0, 0.62, 0.06))


def _sneer(f: Fields) -> FloatArray:
    wing = f.spot((1.2, -3.5), (0.9, 1.3)) * f.skin
    return _push(wing, (0.06, 0.38, 0.10)) + _push(_lip_part(f, upper=True) * 0.45, (0.0, 0.4, 0.08))


BOTH: dict[str, Expression] = {
    "jawOpen": lambda f: open_jaw(f.points, f.jaw),
    "jawForward": lambda f: _push(f.jaw, (0.0, 0.0, 0.7)),
    "mouthClose": mouth_close,
    "mouthFunnel": lambda f: _gather(f, 0.26, 0.66, 0.34),
    "mouthPucker": lambda f: _gather(f, 0.38, 0.75, 0.0),
    "mouthRollLower": lambda f: _roll(f, upper=False),
    "mouthRollUpper": lambda f: _roll(f, upper=True),
    "mouthShrugLower": _shrug_lower,
    "mouthShrugUpper": lambda f: _push(_near_mouth(f, 2.0, 1.2) * f.upper, (0.0, 0.34, 0.14)),
    "cheekPuff": _puff,
    "browInnerUp": _brow_inner,
}

LEFT: dict[str, Expression] = {
    "jawLeft": lambda f: _push(f.jaw, (0.7, 0.0, 0.0)),
    "mouthLeft": lambda f: _push(_near_mouth(f), (0.75, 0.0, -0.05)),
    "mouthSmileLeft": _smile,
    "mouthFrownLeft": lambda f: _push(_corner(f), (0.08, -0.68, -0.12)),
    "mouthDimpleLeft": lambda f: _push(_corner(f, 1.0, 0.9), (0.38, 0.08, -0.42)),
    "mouthStretchLeft": lambda f: _push(_corner(f, 1.7, 1.6), (0.75, -0.28, -0.40)),
    "mouthPressLeft": _press,
    "mouthLowerDownLeft": lambda f: _push(_lip_part(f, upper=False), (0.06, -0.72, -0.06)),
    "mouthUpperUpLeft": lambda f: _push(_lip_part(f, upper=True), (0.06, 0.66, 0.10)),
    "browDownLeft": lambda f: _push(f.spot((2.3, 2.1), (1.9, 0.9)), (-0.22, -0.48, 0.10)),
    "browOuterUpLeft": lambda f: _push(f.spot((4.1, 2.3), (1.6, 1.3)), (0.0, 0.62, 0.0)),
    "cheekSquintLeft": lambda f: _push(f.spot((3.9, -2.4), (1.8, 1.1)), (0.06, 0.40, 0.22)),
    "noseSneerLeft": _sneer,
}
