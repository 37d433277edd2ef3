"""The eyeball meshes: spheres whose rings fall on the edges of pupil and iris."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.parts import FloatArray, IntArray
from facepipe.sample.identity import Identity
from facepipe.sample.solids import Solid, sphere

PUPIL = 9.5  # degrees from the eye's axis
IRIS = 25.5
_SEGMENTS = 24
_RINGS = np.array(
    [5.0, PUPIL - 0.5, PUPIL + 0.5, 14.0, 19.0, 23.0, IRIS - 0.8, IRIS + 0.8, 32.0, 42, 55, 70, 90, 115, 145]
)


@cache
def unit() -> Solid:
    """A unit eyeball that looks along +Z."""
    return sphere(np.radians(_RINGS), _SEGMENTS)


def _polar() -> FloatArray:
    return np.concatenate([[0.0], np.repeat(_RINGS, _SEGMENTS), [180.0]])


def colors(who: Identity) -> FloatArray:
    """(n, 3) linear colours: pupil, iris with a dark edge, white with a little red towards the back."""
    polar = _polar()
    iris = np.array(who.iris)
    white = np.array([0.72, 0.70, 0.68])
    stops = np.array([0, PUPIL - 0.5, PUPIL + 0.5, 14, 19, 23, IRIS - 0.8, IRIS + 0.8, 32, 60, 180])
    table = np.array([iris * 0, iris * 0, iris * 0.4, iris * 0.8, iris * 1.0, iris * 0.65, iris * 0.25, white * 0.85])
    table = np.concatenate([table, [white, white * (1.0, 0.88, 0.85), white * (0.9, 0.6, 0.55)]])
    return np.stack([np.interp(polar, stops, table[:, i]) for i in range(3)], axis=1) + 0.004


def face_groups() -> dict[str, IntArray]:
    """Faces of the white, the iris and the pupil."""
    solid = unit()
    polar = _polar()
    starts = np.concatenate([[0], np.cumsum(solid.counts)[:-1]])
    middle = np.add.reduceat(polar[solid.indices], starts) / solid.counts
    groups = {"Pupil": middle < PUPIL, "Iris": (middle >= PUPIL) & (middle < IRIS), "Sclera": middle >= IRIS}
    return {name: np.nonzero(inside)[0].astype(np.int32) for name, inside in groups.items()}
