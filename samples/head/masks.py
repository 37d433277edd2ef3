"""Soft masks of the parts of a face, in which each identity mode can have a weight of its own.

A mask is a normalised Gaussian of the distance from line segments on the average head, with a flat middle: masks are
smooth, and sum to 1 at every point. Teeth follow the lips and eyeballs the lids.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.vectors import to_segment

Place = tuple[float, float, float]


class Mask(NamedTuple):
    """Segments in cm on the left side and across the middle, the radius of what is flat, and how far it fades."""

    fade: float
    radius: float
    segments: tuple[tuple[Place, Place], ...]
    paired: bool = False  # one for each side


MASKS = {
    "cranium": Mask(3.2, 0.0, (((0.0, 12.5, -1.5), (0.0, 8.0, -6.0)), ((6.5, 8.0, -2.0), (0.0, 8.0, -6.0)))),
    "forehead": Mask(1.6, 0.0, (((0.0, 8.2, 9.6), (4.5, 8.0, 7.6)),)),
    "brow": Mask(0.95, 0.0, (((1.2, 5.7, 10.4), (3.8, 6.1, 9.6)), ((3.8, 6.1, 9.6), (5.6, 5.2, 8.0))), True),
    "eye": Mask(0.6, 0.6, (((1.9, 3.4, 9.0), (4.5, 3.5, 8.4)),), True),
    "bridge": Mask(0.65, 0.0, (((0.0, 4.2, 10.3), (0.0, 2.2, 11.3)),)),
    "nose": Mask(0.85, 0.0, (((0.0, 0.4, 12.4), (0.0, -0.6, 11.6)), ((0.0, -0.3, 11.8), (1.5, -0.5, 10.5)))),
    "cheekbone": Mask(1.1, 0.0, (((4.2, 0.9, 8.9), (6.6, 1.4, 5.6)),), True),
    "cheek": Mask(1.2, 0.0, (((3.6, -1.8, 9.4), (5.6, -2.6, 6.6)),), True),
    "upperLip": Mask(0.7, 0.0, (((0.0, -2.4, 11.3), (2.0, -2.7, 10.4)),)),
    "lowerLip": Mask(0.7, 0.0, (((0.0, -4.2, 11.0), (2.0, -4.3, 10.1)),)),
    "chin": Mask(0.9, 0.0, (((0.0, -6.6, 10.5), (1.6, -6.8, 9.6)),)),
    "jaw": Mask(1.2, 0.0, (((3.6, -6.3, 8.0), (5.9, -4.4, 4.6)),), True),
    "ear": Mask(1.3, 0.0, (((7.9, 4.5, -0.8), (7.6, -0.8, 0.6)),), True),
    "neck": Mask(
        2.6,
        0.0,
        (
            ((0.0, -11.0, 3.0), (0.0, -12.0, -5.5)),
            ((4.5, -10.5, 0.0), (0.0, -18.0, 2.0)),
            ((4.5, -10.5, 0.0), (9.0, -15.0, -1.0)),
            ((0.0, -15.0, -6.0), (9.0, -15.0, -1.0)),
        ),
    ),
}
_BITE = -3.35  # cm, where the teeth meet
_BITE_FADE = 0.15


def masks(points: FloatArray, parts: Mapping[str, slice]) -> FloatArray:
    """(2, k, n) left and right halves of the k `MASKS`; one that is not paired has all of itself in the left half.

    :param points: (n, 3) of the average head
    :param parts: the points of eyeballs, teeth, gums and tongue, by mesh
    """
    sides = np.stack([[_steps(points * (sign, 1, 1), mask) for mask in MASKS.values()] for sign in (1, -1)])
    single = np.array([not mask.paired for mask in MASKS.values()])
    sides[0, single] = sides[:, single].min(axis=0)
    sides[1, single] = np.inf
    found = np.exp((sides.min(axis=(0, 1)) - sides) / 2)
    found /= found.sum(axis=(0, 1))
    names = list(MASKS)
    for side, name in enumerate(("EyeballLeft", "EyeballRight")):
        found[:, :, parts[name]] = 0.0
        found[side, names.index("eye"), parts[name]] = 1.0
    for name in ("Teeth", "GumsAndTongue"):
        upper = 1.0 / (1.0 + np.exp((_BITE - points[parts[name], 1]) / _BITE_FADE))
        found[:, :, parts[name]] = 0.0
        found[0, names.index("upperLip"), parts[name]] = upper
        found[0, names.index("lowerLip"), parts[name]] = 1.0 - upper
    return np.asarray(found)


def _steps(points: FloatArray, mask: Mask) -> FloatArray:
    """(n,) squares of distances beyond the radius, in fades."""
    away = np.min([to_segment(points, np.array(a), np.array(b)) for a, b in mask.segments], axis=0)
    return np.asarray((np.maximum(away - mask.radius, 0.0) / mask.fade) ** 2)
