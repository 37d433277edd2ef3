"""What is measured of shapes that a head got: triangles that turn over, and lips that should meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.contacts import Grid

_TURNS = (0.0, 0.66, -0.66)  # radians about Y: from where a face is seen
_FACE_MM = 150.0  # from the middle of the landmarks: a body is not looked at
_PAIRED_MM = 3.0  # from the rim of one lip to the other's


@dataclass(frozen=True, kw_only=True)
class LipFigures:
    """How lips meet with jawOpen and mouthClose together, in millimetres along Y, against the neutral.

    How far they pass each other is no fault: lips of the built-in head roll in, one rim 6 mm past the other, behind it.
    """

    gap_mean: float  # how much farther the rims are from each other, over all pairs of points
    gap_most: float


def seen_triangles(points: FloatArray, triangles: IntArray, landmarks: FloatArray) -> IntArray:
    """(k, 3) of `triangles` (t, 3) those of the face that are seen from the front or from between front and side.

    :param points: (n, 3) mm, looking along +Z, Y up
    :param landmarks: (68, 3) mm
    """
    near = np.linalg.norm(points - landmarks.mean(axis=0), axis=1) < _FACE_MM
    triangles = triangles[near[triangles].all(axis=1)]
    seen = np.zeros(len(triangles), bool)
    for turn in _TURNS if len(triangles) else ():
        sine, cosine = np.sin(turn), np.cos(turn)
        view = points @ np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]]).T
        number = Grid.of(view, triangles).first(triangles)[1]
        seen[number[number >= 0]] = True
    return triangles[seen]


def lip_figures(points: FloatArray, sides: IntArray, delta: FloatArray) -> LipFigures | None:
    """How lips meet; None: no point of one lip is near to one of the other.

    Pairs are points of upper and lower lip of which each is the nearest to the other, so that those are the rims.

    :param points: (n, 3) mm, Y up
    :param sides: (n,) 1 and -1 of the upper and lower lip
    :param delta: (n, 3) of jawOpen and mouthClose together
    """
    from scipy.spatial import cKDTree

    upper, lower = np.flatnonzero(sides == 1), np.flatnonzero(sides == -1)
    if not len(upper) or not len(lower):
        return None
    distances, below = cKDTree(points[lower]).query(points[upper])
    above = cKDTree(points[upper]).query(points[lower])[1]
    paired = (above[below] == np.arange(len(upper))) & (distances < _PAIRED_MM)
    apart = (delta[upper[paired]] - delta[lower[below[paired]]])[:, 1]
    if not len(apart):
        return None
    return LipFigures(gap_mean=float(np.maximum(apart, 0.0).mean()), gap_most=float(apart.max(initial=0.0)))
