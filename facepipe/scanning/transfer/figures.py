"""Which triangles of a face are seen, of which it shows where they turn over."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.contacts import Grid

_TURNS = (0.0, 0.66, -0.66)  # radians about Y: from where a face is seen
_FACE_MM = 150.0  # from the middle of the landmarks: a body is not looked at


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
