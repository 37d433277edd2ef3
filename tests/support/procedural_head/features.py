"""Features of the face as displacements of the base surface: brows, sockets, cheeks, nose, muzzle, chin, neck."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head.identity import Identity


def displace(base: FloatArray, who: Identity) -> FloatArray:
    """(n, 3) base points moved onto the featured face; lips, lids and ears are placed afterwards."""
    points = base.copy()
    points += _bones(base, who)
    points += _nose(base, who)
    return points


def bump(points: FloatArray, center: tuple[float, float], radii: tuple[float, float], power: float = 1.0) -> FloatArray:
    """(n,) a bump of height 1 in the frontal plane, mirrored in x, on the front of the head only."""
    squared = ((np.abs(points[:, 0]) - center[0]) / radii[0]) ** 2 + ((points[:, 1] - center[1]) / radii[1]) ** 2
    return np.asarray(np.exp(-(squared**power)) * np.clip(points[:, 2] / 2.0, 0.0, 1.0))


def _ball(points: FloatArray, center: tuple[float, float, float], radius: float) -> FloatArray:
    offset = np.abs(points[:, :1]) * (1.0, 0.0, 0.0) + points * (0.0, 1.0, 1.0) - center
    return np.asarray(np.exp(-(offset**2).sum(axis=1) / radius**2))


def _bones(base: FloatArray, who: Identity) -> FloatArray:
    x_sign = np.sign(base[:, 0])
    move = np.zeros_like(base)
    brow_y = 1.95 + 0.1 * who.brow_height
    move[:, 2] += (0.30 + 0.16 * who.brow_depth) * bump(base, (2.3, brow_y), (2.3, 0.75))
    move[:, 2] += 0.12 * bump(base, (0.0, brow_y - 0.1), (1.0, 0.8))
    move[:, 2] -= 0.55 * bump(base, (2.5 + 0.1 * who.eye_spacing, 0.1), (1.35, 0.95))
    move[:, 2] -= 0.25 * bump(base, (1.4, 0.15), (0.6, 0.8))
    move[:, 2] -= 0.16 * bump(base, (2.6, -2.1), (1.3, 0.7))
    cheek = _ball(base, (5.1, -2.0, 5.6), 2.2) * (0.42 + 0.22 * who.cheekbones)
    move += cheek[:, None] * np.stack([0.75 * x_sign, 0 * x_sign, 0.7 + 0 * x_sign], axis=1)
    hollow = _ball(base, (5.4, -6.2, 4.6), 2.4) * (-0.35 + 0.4 * who.cheek_fullness)
    move += hollow[:, None] * np.stack([0.8 * x_sign, 0 * x_sign, 0.5 + 0 * x_sign], axis=1)
    temple = _ball(base, (6.6, 2.6, 4.2), 2.4) * -0.42
    move += temple[:, None] * np.stack([0.9 * x_sign, 0 * x_sign, 0.4 + 0 * x_sign], axis=1)
    gonion = _ball(base, (5.6, -8.0, 1.6), 1.9) * (0.35 + 0.3 * who.jaw_width)
    move += gonion[:, None] * np.stack([0.9 * x_sign, -0.5 + 0 * x_sign, 0 * x_sign], axis=1)
    return move + _lower_face(base, who) + _neck(base)


def _lower_face(base: FloatArray, who: Identity) -> FloatArray:
    move = np.zeros_like(base)
    mouth_y = -6.6 - 0.12 * who.mouth_height
    move[:, 2] += 0.62 * bump(base, (0.0, mouth_y), (2.3, 2.3))
    move[:, 2] -= 0.22 * bump(base, (3.4, mouth_y - 0.2), (0.9, 1.6))
    move[:, 2] -= 0.30 * bump(base, (0.0, -8.4), (1.6, 0.55))
    chin_width = 1.25 + 0.2 * who.chin_width
    move[:, 2] += 0.42 * bump(base, (0.35 + 0.15 * who.chin_width, -9.85 - 0.25 * who.chin_length), (chin_width, 0.95))
    fold = np.exp(-(((np.abs(base[:, 0]) - (2.05 - 0.42 * (base[:, 1] + 4.2))) / 0.4) ** 2))
    move[:, 2] -= 0.13 * fold * bump(base, (2.6, -5.3), (1.5, 1.3))
    return move


def _neck(base: FloatArray) -> FloatArray:
    move = np.zeros_like(base)
    below = np.clip((-11.9 - base[:, 1]) / 1.5, 0.0, 1.0)
    larynx = np.exp(-((base[:, 0] / 0.9) ** 2) - ((base[:, 1] + 13.6) / 1.0) ** 2)
    move[:, 2] += 0.3 * larynx * (base[:, 2] > 0) * below
    # The sternomastoid muscles run from behind the ears to the pit of the throat.
    muscle_x = 5.0 + (base[:, 1] + 9.0) * 0.36
    muscle = np.exp(-(((np.abs(base[:, 0]) - muscle_x) / 0.9) ** 2)) * (base[:, 2] > -2.0) * below
    move[:, 2] += 0.35 * muscle
    return move


# The nose's ridge: height on the base surface, and where the nose takes it (height, depth).
_RIDGE = np.array(
    [
        (1.7, 1.70, 9.30),
        (0.75, 0.75, 9.15),
        (0.0, 0.00, 9.42),
        (-1.3, -1.35, 10.05),
        (-2.2, -2.50, 10.72),
        (-2.8, -3.28, 11.15),
        (-3.2, -3.76, 11.25),
        (-3.55, -4.14, 11.05),
        (-3.9, -4.42, 10.62),
        (-4.35, -4.66, 10.10),
        (-4.75, -4.80, 9.70),
        (-5.3, -5.30, 9.40),
    ]
)
_BASE_DEPTH = 9.1  # of the face without its nose


def ridge(who: Identity) -> FloatArray:
    """(k, 3) the table above for an identity."""
    table = _RIDGE.copy()
    height = table[:, 0]
    low = np.exp(-(((height + 3.6) / 1.1) ** 2))
    tip = np.exp(-(((height + 3.3) / 0.6) ** 2))
    table[:, 1] -= 0.22 * who.nose_length * low
    table[:, 1] += 0.16 * who.nose_tip * tip
    table[:, 2] += 0.17 * who.nose_depth * low + 0.15 * who.nose_bridge * np.exp(-(((height + 1.2) / 1.1) ** 2))
    return table


def _nose(base: FloatArray, who: Identity) -> FloatArray:
    """(n, 3) the pull of the nose: its ridge and tip, its wings, and the crease behind them."""
    from scipy.interpolate import PchipInterpolator

    table = ridge(who)[::-1]
    x, y = np.abs(base[:, 0]), np.clip(base[:, 1], -5.3, 1.7)
    to = PchipInterpolator(table[:, 0], table[:, 1:])(y)
    wide = np.interp(y, [-4.7, -4.1, -3.7, -3.2, -2.4, -1.2, 0.5, 1.6], [0.5, 0.5, 0.82, 1.0, 0.95, 0.92, 0.85, 1.0])
    fall = np.exp(-((x / (wide * (1 + 0.05 * who.nose_width))) ** 2.4))
    within = (
        np.clip((1.7 - base[:, 1]) / 0.8, 0, 1)
        * np.clip((base[:, 1] + 5.3) / 0.5, 0, 1)
        * np.clip(base[:, 2] / 2, 0, 1)
    )
    low = 0.16 * who.nose_length
    wing_x = 1.18 + 0.15 * who.nose_width
    wing = bump(base, (wing_x, -3.66 - low), (0.56, 0.66), 1.6)
    side = 0.22 * bump(base, (1.15, -2.4), (0.8, 1.4))
    crease = 0.22 * bump(base, (wing_x + 0.68, -3.6 - low), (0.2, 0.7))
    ahead = _smooth_max(np.maximum(to[:, 1] - _BASE_DEPTH, 0) * fall, 1.12 * wing, 0.12)
    down = (to[:, 0] - y) * fall - 0.34 * wing * (1 - fall)
    out = 0.16 * np.sign(base[:, 0]) * bump(base, (wing_x + 0.3, -3.75 - low), (0.45, 0.6))
    return np.stack([out, down * within, ahead * within + side - crease], axis=1)


def _smooth_max(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    return np.asarray(0.5 * (a + b + np.sqrt((a - b) ** 2 + width**2)) - 0.5 * width)
