"""Where skin sags with the years: folds and hollows that are there without any expression, by place on the head.

A fold is a line with a groove along it and a swelling beside it, a hollow or a pad a Gaussian; places are those of the
average head, in cm, of the left side (x to the left, y up), and the other side mirrors them. Lines run where anatomy
has them; widths and depths were set by eye.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.heads.asset import arrays

_FRONT = (1.0, 4.0)  # z in cm from which, and where in full, skin is the face's


@dataclass(frozen=True, kw_only=True)
class Fold:
    """A groove along a line."""

    line: tuple[tuple[float, float], ...]  # x and y; the swelling is on its left as one goes along
    width: float  # cm
    depth: float  # cm in the oldest
    swelling: float  # height beside it, share of the depth


@dataclass(frozen=True, kw_only=True)
class Pad:
    """Skin that sinks or swells."""

    middle: tuple[float, float]
    radii: tuple[float, float]
    height: float  # cm in the oldest


FOLDS: Mapping[str, Fold] = {
    "nasolabial": Fold(
        line=((1.85, 0.1), (2.4, -0.9), (3.05, -2.1), (3.45, -3.2), (3.6, -4.2)), width=0.30, depth=0.15, swelling=0.75
    ),
    "marionette": Fold(
        line=((2.6, -3.75), (2.75, -4.6), (2.85, -5.5), (2.8, -6.2)), width=0.24, depth=0.10, swelling=0.7
    ),
    "eyeBag": Fold(
        line=((1.75, 2.75), (2.2, 2.25), (2.9, 1.95), (3.7, 2.0), (4.4, 2.4)), width=0.24, depth=0.11, swelling=1.1
    ),
    "tearTrough": Fold(line=((1.55, 2.5), (2.1, 1.75), (2.9, 1.3), (3.8, 1.2)), width=0.34, depth=0.08, swelling=0.3),
    "hood": Fold(
        line=((2.1, 4.1), (2.9, 4.45), (3.9, 4.3), (4.7, 3.85), (5.3, 3.0)), width=0.20, depth=0.08, swelling=0.9
    ),
    "mentolabial": Fold(line=((0.0, -5.35), (0.8, -5.4), (1.6, -5.75)), width=0.30, depth=0.07, swelling=0.2),
}
PADS: Mapping[str, Pad] = {
    "jowl": Pad(middle=(4.4, -5.7), radii=(1.0, 1.1), height=0.22),
    "cheekHollow": Pad(middle=(4.9, -2.2), radii=(1.2, 1.9), height=-0.20),
    "temple": Pad(middle=(6.4, 5.6), radii=(1.0, 1.7), height=-0.22),
}


@cache
def sags() -> Mapping[str, FloatArray]:
    """Height in cm of each fold and pad in the oldest over the face's tile, (128, 128), top row first."""
    places = arrays("skin_maps")["face_places"][::2, ::2].astype(np.float32)
    across, up, front = np.abs(places[..., 0]), places[..., 1], places[..., 2]
    shown = np.clip((front - _FRONT[0]) / (_FRONT[1] - _FRONT[0]), 0, 1)
    at = np.stack([across, up], axis=-1)
    found = {name: shown * _fold(fold, at) for name, fold in FOLDS.items()}
    for name, pad in PADS.items():
        away = (at - np.array(pad.middle, np.float32)) / np.array(pad.radii, np.float32)
        found[name] = shown * np.float32(pad.height) * np.exp(-(away**2).sum(axis=-1))
    return found


def _fold(fold: Fold, at: FloatArray) -> FloatArray:
    """(...,) height of a fold at places (..., 2).

    A Gaussian swelling of the signed distance beside the line less one of the distance: what sags hangs over its fold
    from one side.
    """
    nearest = np.full(at.shape[:-1], np.inf, np.float32)
    beside, along = np.zeros_like(nearest), np.zeros_like(nearest)
    line = np.array(fold.line, np.float32)
    for number, (a, b) in enumerate(pairwise(line)):
        way = (b - a) / np.linalg.norm(b - a)
        off = at - a
        share = np.clip(off @ way / np.linalg.norm(b - a), 0, 1)
        away = np.linalg.norm(off - share[..., None] * (b - a), axis=-1)
        closer = away < nearest
        nearest = np.where(closer, away, nearest)
        beside = np.where(closer, np.sign(way[0] * off[..., 1] - way[1] * off[..., 0]) * away, beside)
        along = np.where(closer, (number + share) / (len(line) - 1), along)
    ends = np.sin(np.pi * np.clip(0.12 + 0.76 * along, 0, 1)) ** 0.7  # shallow at both ends
    groove = np.exp(-((nearest / fold.width) ** 2))
    swollen = np.exp(-(((beside - 2.2 * fold.width) / (1.7 * fold.width)) ** 2))
    return np.asarray(np.float32(fold.depth) * ends * (np.float32(fold.swelling) * swollen - groove))
