"""The base surface of the head: horizontal loops through front, side and back profiles, without features.

Units are centimetres; the origin lies between the eyes' height and the ears' axis: y = 0 at the pupils, z = 0 at the
ear canals. A surface point has two coordinates: `angle`, the polar angle around the head (0 front, pi/2 the
subject's left), and `level`, a position along the table below from the crown (0) to the neck border (17).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from procedural_head.identity import Identity

# level: front y, front z | side y, half width, side z | back y, back z | squareness of the loop's front half
_PROFILES = np.array(
    [
        (11.4, -0.9, 11.4, 0.0, -0.9, 11.4, -0.9, 2.0),  # 0 apex
        (11.1, 2.2, 10.98, 2.8, -0.9, 11.05, -4.0, 2.0),  # 1
        (10.05, 5.05, 9.75, 5.05, -0.9, 10.0, -6.8, 2.05),  # 2
        (8.35, 7.25, 7.95, 6.6, -0.9, 8.1, -8.7, 2.1),  # 3
        (6.3, 8.6, 6.1, 7.3, -0.9, 5.8, -9.6, 2.15),  # 4 hairline
        (4.1, 9.28, 4.2, 7.5, -0.8, 3.4, -9.8, 2.2),  # 5 forehead
        (1.8, 9.45, 2.1, 7.35, -0.5, 1.2, -9.4, 2.2),  # 6 brows
        (0.0, 9.05, 0.3, 7.1, -0.2, -0.9, -8.7, 2.15),  # 7 eyes
        (-2.3, 8.95, -1.6, 6.9, 0.0, -2.9, -7.8, 2.1),  # 8 cheekbones
        (-4.7, 9.1, -3.3, 6.6, 0.0, -4.7, -7.1, 2.05),  # 9 nose base
        (-6.55, 9.1, -4.7, 6.15, -0.1, -6.3, -6.7, 2.0),  # 10 mouth
        (-8.35, 8.8, -6.0, 5.7, -0.3, -7.9, -6.5, 1.92),  # 11 chin groove
        (-9.8, 8.9, -7.2, 5.3, -0.6, -9.3, -6.5, 1.85),  # 12 chin
        (-10.9, 8.1, -8.5, 4.95, -1.0, -10.5, -6.6, 1.88),  # 13 jawline
        (-11.35, 6.1, -9.9, 4.65, -1.3, -11.7, -6.7, 2.0),  # 14 under the chin
        (-12.3, 4.5, -11.5, 4.55, -1.5, -13.0, -6.9, 2.0),  # 15 throat
        (-14.0, 4.0, -13.7, 4.75, -1.6, -14.6, -7.1, 2.0),  # 16
        (-16.0, 3.8, -16.0, 5.15, -1.7, -16.4, -7.5, 2.0),  # 17 neck border
    ]
)
_LEVELS = np.arange(len(_PROFILES), dtype=np.float64)


@dataclass(frozen=True)
class Skull:
    """The base surface of one identity."""

    profiles: Any  # spline: level -> the eight columns of the table

    def surface(self, angle: FloatArray, level: FloatArray) -> FloatArray:
        """(n, 3) points at surface coordinates (n,), (n,)."""
        front_y, front_z, side_y, width, side_z, back_y, back_z, square = self.profiles(level).T
        sine, cosine = np.abs(np.sin(angle)), np.cos(angle)
        ahead = cosine >= 0
        depth = np.maximum(np.abs(np.where(ahead, front_z, back_z) - side_z), 1e-6)
        power = np.where(ahead, square, 2.15)
        width = np.maximum(width, 1e-6)
        radius = ((sine / width) ** power + (np.abs(cosine) / depth) ** power) ** (-1.0 / power)
        share = sine**2
        y = np.where(ahead, front_y, back_y) * (1 - share) + side_y * share
        return np.stack([radius * np.sin(angle), y, side_z + radius * cosine], axis=1)

    def coordinates(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Surface coordinates (n,), (n,) of the front points with the given x and y (Newton's method)."""
        angle, level = np.arctan2(x, 9.0), np.interp(-y, -_PROFILES[:, 0], _LEVELS)
        step = 1e-5
        for _ in range(8):
            here = self.surface(angle, level)[:, :2]
            by_angle = (self.surface(angle + step, level)[:, :2] - here) / step
            by_level = (self.surface(angle, level + step)[:, :2] - here) / step
            missing = np.stack([x, y], axis=1) - here
            determinant = by_angle[:, 0] * by_level[:, 1] - by_level[:, 0] * by_angle[:, 1]
            angle = angle + (missing[:, 0] * by_level[:, 1] - by_level[:, 0] * missing[:, 1]) / determinant
            level = level + (by_angle[:, 0] * missing[:, 1] - missing[:, 0] * by_angle[:, 1]) / determinant
            level = np.clip(level, 0.5, 16.5)
        return angle, level


def build(who: Identity) -> Skull:
    """The base surface of an identity."""
    from scipy.interpolate import CubicSpline

    table = _PROFILES.copy()
    level = _LEVELS
    table[:, 3] *= (
        1 + 0.022 * who.cranium_width * _near(level, 3.5, 3.0) + 0.025 * who.face_width * _near(level, 8, 2.5)
    )
    table[:, 3] *= 1 + 0.04 * who.jaw_width * _near(level, 12.0, 1.8) + 0.05 * who.neck_width * _near(level, 16.5, 1.8)
    table[:, [0, 2, 5]] += 0.3 * who.cranium_height * _near(level, 0.0, 2.2)[:, None]
    table[:, 0] -= 0.3 * who.chin_length * _near(level, 13.0, 1.6)
    table[:, 2] -= 0.12 * who.chin_length * _near(level, 13.0, 1.6)
    table[:, 1] += 0.3 * who.chin_depth * _near(level, 12.6, 1.3)
    table[:, 7] += 0.07 * who.jaw_width * _near(level, 12.0, 2.5) + 0.05 * who.face_width * _near(level, 8.0, 2.5)
    return Skull(CubicSpline(level, table, axis=0))


def _near(level: FloatArray, center: float, width: float) -> FloatArray:
    return np.asarray(np.exp(-(((level - center) / width) ** 2)))
