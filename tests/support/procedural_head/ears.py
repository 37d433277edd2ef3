"""The ear patch: a shell that rises from the side of the head, rolls over at the helix and sinks into the concha."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head.identity import Identity

RINGS = 8
_CENTER = np.array([1.35, 0.15])  # of the outline, in the ear's plane: backwards, upwards
# Outline of the ear around its centre: angle in degrees (0 back, 90 up, 180 front, 270 down) and distance.
_OUTLINE_ANGLE = (0, 30, 60, 90, 118, 150, 180, 215, 245, 268, 290, 318, 340, 360)
_OUTLINE_RADIUS = (1.8, 2.15, 2.65, 2.85, 2.5, 1.65, 1.2, 1.3, 1.95, 2.7, 2.65, 2.0, 1.8, 1.8)


def root(outline: FloatArray) -> FloatArray:
    """(spokes, 2) surface coordinates of the ear's root from those of the patch's outline: an upright oval."""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    offset = outline - middle
    reach = np.linalg.norm(offset / np.abs(offset).max(axis=0), axis=1, keepdims=True)
    return np.asarray(middle + offset / reach * (0.84, 0.97))


def place(outline: FloatArray, root_points: FloatArray, who: Identity) -> FloatArray:
    """(rings + 1, spokes, 3) points of the left ear's patch; its rings 0 and 1 (spokes, 3) lie on the head."""
    spokes = outline.shape[0]
    turn = 2 * np.pi * np.arange(spokes) / spokes
    middle = outline.mean(axis=0)
    edge = _edge(turn) * (1.1 + 0.07 * who.ear_size)
    angle = np.radians(27 + 6 * who.ear_angle)
    frame = _frame(angle)
    origin = middle + np.array([0.05, 0.3, 0.95])
    front = np.clip(-np.cos(turn), 0, 1) ** 0.7
    back = 1 - front
    lobe = np.clip(-np.sin(turn) - 0.55, 0, 1) / 0.45
    center = _CENTER
    rows = [root_points]
    for scale, height in _shell(front, back, lobe):
        flat = center + (edge - center) * scale[:, None]
        rows.append(origin + flat @ frame[:2] + height[:, None] * frame[2])
    rows.insert(1, 0.4 * rows[0] + 0.6 * rows[1] - 0.24 * back[:, None] * frame[2])
    shell = np.stack(rows)
    return np.concatenate([outline[None], shell])


def _edge(turn: FloatArray) -> FloatArray:
    from scipy.interpolate import CubicSpline

    radius = CubicSpline(np.radians(_OUTLINE_ANGLE), _OUTLINE_RADIUS, bc_type="periodic")(turn)
    return np.asarray(_CENTER + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1))


def _frame(angle: float) -> FloatArray:
    """(3, 3) rows: backwards along the ear, upwards, and out of its plane; leaning back by 12 degrees."""
    lean = np.radians(12)
    backwards = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    out = np.array([np.cos(angle), 0.0, np.sin(angle)])
    up = np.array([0.0, 1.0, 0.0])
    return np.stack([np.cos(lean) * backwards - np.sin(lean) * up, np.sin(lean) * backwards + np.cos(lean) * up, out])


def _shell(front: FloatArray, back: FloatArray, lobe: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Scale of the outline and height over the ear's plane of rings 3..8."""
    one = np.ones_like(front)
    return [
        (one * 1.0, -0.05 * back + 0.12 * front),
        (one * 0.97, 0.20 * back * (1 - lobe) + 0.14 * front),
        (one * 0.84 + 0.04 * front, 0.12 * back * (1 - lobe) + 0.1 * lobe + 0.2 * front),
        (one * 0.70 + 0.06 * front, -0.1 * back * (1 - lobe) + 0.1 * lobe + 0.2 * front),
        (one * 0.50 + 0.1 * front, 0.06 * back + 0.02 * front),
        (one * 0.36, -0.55 * one),
    ]
