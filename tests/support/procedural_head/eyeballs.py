"""The eyeball meshes: spheres whose rings fall on the edges of pupil and iris."""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.parts import Texture, TextureInput
from procedural_head import texture as baking
from procedural_head.identity import Identity
from procedural_head.solids import Solid, sphere

PUPIL = 9.5  # degrees from the eye's axis
IRIS = 25.5
_SEGMENTS = 24
_SPREAD = 0.6  # gives the iris more of the texture
_TEXTURE = 256  # pixels a side
_RINGS = np.array(
    [5.0, PUPIL - 0.5, PUPIL + 0.5, 14.0, 19.0, 23.0, IRIS - 0.8, IRIS + 0.8, 32.0, 42, 55, 70, 90, 115, 145]
)


@cache
def unit() -> Solid:
    """A unit eyeball that looks along +Z."""
    return sphere(np.radians(_RINGS), _SEGMENTS, _SPREAD)


def _polar() -> FloatArray:
    return np.concatenate([[0.0], np.repeat(_RINGS, _SEGMENTS), [180.0]])


def colors(who: Identity) -> FloatArray:
    """(n, 3) linear colours: pupil, iris with a dark edge, white with a little red towards the back."""
    return _at(_polar(), who)


def texture(who: Identity) -> TextureInput:
    """The same colours as a picture, with the iris's fibres."""
    middle = 2 * (np.arange(_TEXTURE) + 0.5) / _TEXTURE - 1
    y, x = np.meshgrid(middle[::-1], middle, indexing="ij")
    polar = 180 * np.minimum(np.hypot(x, y) / 0.98, 1.0) ** (1 / _SPREAD)
    around = np.arctan2(y, x)
    fibres = sum(np.cos(n * around + phase + 0.06 * polar) for n, phase in ((23, 0.3), (37, 1.7), (53, 4.1), (61, 2.2)))
    iris = (polar > PUPIL + 0.5) & (polar < IRIS - 0.8)
    linear = _at(polar.ravel(), who) * (1 + 0.13 * fibres * iris).reshape(-1, 1)
    pixels = (baking.srgb(np.clip(linear, 0, 1)) * 255 + 0.5).astype(np.uint8).reshape(_TEXTURE, _TEXTURE, 3)
    return TextureInput(texture=Texture(name="eye.png", data=baking.png(pixels)))


def _at(polar: FloatArray, who: Identity) -> FloatArray:
    """(n, 3) linear colours at angles (n,) from the eye's axis in degrees."""
    iris = np.array(who.iris)
    white = np.array([0.72, 0.70, 0.68])
    stops = np.array([0, PUPIL - 0.5, PUPIL + 0.5, 14, 19, 23, IRIS - 0.8, IRIS + 0.8, 32, 60, 180])
    inner = np.array([0.0, 0.0, 0.4, 0.8, 1.0, 0.65, 0.25])[:, None] * iris
    outer = np.array([(0.85, 0.85, 0.85), (1.0, 1.0, 1.0), (1.0, 0.88, 0.85), (0.9, 0.6, 0.55)]) * white
    table = np.concatenate([inner, outer])
    return np.stack([np.interp(polar, stops, table[:, i]) for i in range(3)], axis=1) + 0.004


def face_groups() -> dict[str, IntArray]:
    """Faces of the white, the iris and the pupil."""
    solid = unit()
    polar = _polar()
    starts = np.concatenate([[0], np.cumsum(solid.counts)[:-1]])
    middle = np.add.reduceat(polar[solid.indices], starts) / solid.counts
    groups = {"Pupil": middle < PUPIL, "Iris": (middle >= PUPIL) & (middle < IRIS), "Sclera": middle >= IRIS}
    return {name: np.nonzero(inside)[0].astype(np.int32) for name, inside in groups.items()}
