"""Features of the face as displacements of the base surface: brows, sockets, cheeks, nose, muzzle, chin, neck."""

from __future__ import annotations

import numpy as np

from facepipe.parts import FloatArray
from facepipe.sample.identity import Identity


def displace(base: FloatArray, who: Identity) -> FloatArray:
    """(n, 3) base points moved onto the featured face; lips, lids and ears are placed afterwards."""
    points = base.copy()
    points += _bones(base, who)
    points[:, 2] = _with_nose(base, points[:, 2], who)
    low = 0.2 * who.nose_length
    points[:, 1] -= 0.2 * bump(base, (0.3, -4.12 - low), (0.8, 0.36))
    points[:, 0] += 0.1 * np.sign(base[:, 0]) * bump(base, (1.45, -4.0 - low), (0.4, 0.5))
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
    move[:, 2] -= 0.45 * bump(base, (1.35, 0.15), (0.55, 0.8))
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


def nose_profile(who: Identity) -> tuple[FloatArray, FloatArray]:
    """(k,), (k,) heights y (descending) and depths z of the nose's ridge, from the glabella to the upper lip."""
    length = 0.22 * who.nose_length
    deep = 0.16 * who.nose_depth
    tip = 0.14 * who.nose_tip
    y = np.array(
        [1.7, 0.75, 0.0, -1.3, -2.6, -3.25 - length, -3.75 - length + tip, -4.1 - length + tip, -4.75 - length, -5.3]
    )
    z = np.array([9.3, 9.15, 9.4, 10.0, 10.65 + deep, 11.1 + deep, 11.25 + deep, 10.95 + deep, 9.75, 9.3])
    z[2:5] += 0.15 * who.nose_bridge
    return y, z


def _with_nose(base: FloatArray, z: FloatArray, who: Identity) -> FloatArray:
    from scipy.interpolate import PchipInterpolator

    heights, depths = nose_profile(who)
    x, y = np.abs(base[:, 0]), base[:, 1]
    ridge = PchipInterpolator(heights[::-1], depths[::-1], extrapolate=True)(np.clip(y, -5.3, 1.7))
    narrow = (
        np.interp(y, [-4.6, -3.5, -2.6, -1.2, 0.5, 1.6], [0.8, 0.98, 0.86, 0.82, 0.72, 0.9]) + 0.05 * who.nose_width
    )
    rise = np.maximum(ridge - 9.1, 0.0) * np.exp(-((x / narrow) ** 2.3))
    within = np.clip((1.7 - y) / 0.8, 0, 1) * np.clip((y + 5.3) / 0.5, 0, 1) * np.clip(base[:, 2] / 2.0, 0, 1)
    wing_x, wing_y = 1.12 + 0.14 * who.nose_width, -3.95 - 0.18 * who.nose_length
    wing = 1.0 * bump(base, (wing_x, wing_y), (0.6, 0.6), 1.4)
    side = 0.25 * bump(base, (1.15, -2.6), (0.8, 1.5))
    crease = 0.14 * bump(base, (wing_x + 0.7, wing_y + 0.1), (0.22, 0.6))
    return np.asarray(z + _smooth_max(rise * within, wing, 0.12) + side - crease)


def _smooth_max(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    return np.asarray(0.5 * (a + b + np.sqrt((a - b) ** 2 + width**2)) - 0.5 * width)
