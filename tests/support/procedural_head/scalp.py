"""Cropped hair: a shell over the skull with its border along the hairline."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.parts import UvSet
from procedural_head import features
from procedural_head.identity import Identity
from procedural_head.skull import Skull
from procedural_head.solids import Solid

# Hairline: degrees around the head (0 front, 180 back) and height y.
_ANGLE = (0, 10, 22, 36, 44, 52, 58, 63, 67, 71, 76, 82, 92, 104, 112, 118, 125, 145, 180)
_HEIGHT = (6.1, 6.15, 6.15, 5.65, 4.9, 3.8, 2.7, 1.3, -0.4, -1.0, 0.4, 1.9, 2.7, 2.5, 1.0, -1.8, -4.8, -6.0, -6.5)
_AROUND = 40
_DEPTH = np.interp(
    np.arange(16), [0, 1, 2, 3, 5, 8, 15], [-0.12, 0.14, 0.26, 0.34, 0.43, 0.5, 0.56]
)  # of the shell over the skull, from the border up
_UP = np.interp(
    np.arange(16), [0, 1, 2, 3, 15], [0.0, 0.022, 0.065, 0.12, 0.965]
)  # share of the way from the hairline to the crown


def line(angle: FloatArray) -> FloatArray:
    """y of the hairline at angles (n,) around the head in radians."""
    from scipy.interpolate import PchipInterpolator

    turned = np.degrees(np.abs(np.arctan2(np.sin(angle), np.cos(angle))))
    return np.asarray(PchipInterpolator(_ANGLE, _HEIGHT)(turned))


def build(skull: Skull, who: Identity) -> Solid:
    """The shell of an identity."""
    turn = 2 * np.pi * np.arange(_AROUND) / _AROUND
    angle = turn + 0.2 * np.sin(2 * turn)  # denser at the sides, where the hairline turns around the ears
    level = _levels(skull, angle)
    angles = np.tile(angle, (len(_UP), 1))
    base = features.displace(skull.surface(angles.ravel(), level.ravel()), who)
    crown = skull.surface(np.zeros(1), np.full(1, 1e-3))
    counts, indices = _faces()
    points = np.concatenate([base, crown])
    normals = point_normals(points, point_triangles(counts, indices))
    depth = np.append(np.repeat(_DEPTH, _AROUND), _DEPTH[-1])
    points = points + depth[:, None] * normals
    return Solid(points, counts, indices, _uvs(angle))


def colors(who: Identity) -> FloatArray:
    """(n, 3) colours of the shell: strands of lighter and darker hair."""
    light = np.random.default_rng(5).uniform(0.7, 1.35, size=_AROUND // 2 + 1)
    light = np.concatenate([light, light[-2:0:-1]])  # symmetric
    shade = np.append(np.tile(light, len(_UP)), 1.0) * np.append(np.repeat(0.85 + 0.3 * _UP, _AROUND), 1.15)
    return np.asarray(shade[:, None] * np.array(who.hair))


def _levels(skull: Skull, angle: FloatArray) -> FloatArray:
    """(rows, around) levels of the shell's points: `_UP` shares of the arc from the hairline to the crown."""
    levels = np.linspace(0.0, 14.0, 281)
    wanted = line(angle)
    found = np.empty((len(_UP), len(angle)))
    for i, turn in enumerate(angle):
        arc = skull.surface(np.full(len(levels), turn), levels)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(arc, axis=0), axis=1))])
        border = np.interp(-wanted[i], -arc[:, 1], length)
        found[:, i] = np.interp(border * (1 - _UP), length, levels)
    return found


def _faces() -> tuple[IntArray, IntArray]:
    ids = np.arange(len(_UP) * _AROUND).reshape(len(_UP), _AROUND)
    after = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], after[:-1], after[1:], ids[1:]], axis=-1).reshape(-1, 4)
    fan = np.stack([ids[-1], after[-1], np.full(_AROUND, ids.size)], axis=1)
    counts = np.repeat([4, 3], [len(quads), len(fan)]).astype(np.int32)
    return counts, np.concatenate([quads.ravel(), fan.ravel()]).astype(np.int32)


def _uvs(angle: FloatArray) -> UvSet:
    """Azimuthal around the crown."""
    radius = 0.48 * (1 - _UP[:, None])
    values = 0.5 + np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=-1).reshape(-1, 2)
    return UvSet(values=np.concatenate([values, [(0.5, 0.5)]]))
