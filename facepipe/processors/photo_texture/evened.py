"""Which of a photo's colours are skin, and what of them is light that the fit has missed: by robust statistics.

Colours are natural logarithms of ratios to the template's, at points. What varies with the direction of the surface, or
widely from one side of the face to the other, is light; true colours hardly do.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.geometry.harmonics import harmonics
from facepipe.geometry.polygons import components
from facepipe.processors.photo_texture.observed import GREY, Exposure
from facepipe.processors.photo_texture.seen_skin import step
from facepipe.processors.photo_texture.skin_surface import SkinSurface

# all lengths are shares of the eyes' distance
_INNER = (0.28, 0.55)  # off the landmarks inside the face: skin up to the first, anything beyond the second
_WIDE = 0.25  # over which both sides of a face are made alike
_LEVELS = ((0.15, 0.45), (0.05, 0.12), (0.05, 0.12))  # least and largest deviation of skin: brightness, two hues
_STRANGE = (2.8, 7.0)  # deviations beyond which a colour is no skin, outside the face and inside
_EDGE = (0.03, 0.10)  # off what is no skin: where confidence begins, where it is full
_GRAIN = 0.03  # what is smaller is judged with what is around it
_OUTLIER = 0.2  # of a logarithm
_RIDGE = 0.02
_BRIGHTEST, _LEVEL_TRUST = 1.15, 0.7  # light of the brightest skin of a well exposed photo, and what that counts
_HUE_TRUST = 0.7  # that the light of a photo is white, as cameras make it
_FAINT = 0.3  # confidence that doesn't join patches of skin


def balance(photo: Exposure) -> FloatArray:
    """(3,) factor of a photo's light that makes it likely.

    A photo tells light and colour of the skin apart by their product alone: a fit leaves the skin about as the template
    has it. But photos are exposed so that a face is well lit, and balanced so that its light is white.
    """
    bright = photo.white[photo.trust > _FAINT]
    if not len(bright):
        return np.ones(3)
    level = float(np.quantile(bright @ GREY, 0.9))
    mean = np.average(photo.white, axis=0, weights=photo.trust)
    hue = mean / float(mean @ GREY)
    factor = (_BRIGHTEST / level) ** _LEVEL_TRUST * hue**-_HUE_TRUST
    return np.asarray(np.clip(factor, 0.1, 10.0))


def inner(skin: SkinSurface) -> FloatArray:
    """(n,) 1 on the face, 0 off it: hair, ears, neck."""
    marks = skin.points[skin.landmarks]
    cheeks = (marks[1:16] + marks[33]) / 2
    distance = cKDTree(np.concatenate([marks[17:], cheeks])).query(skin.points)[0]
    return 1 - step(distance / skin.eye_distance(skin.points), *_INNER)


def missed_light(normals: FloatArray, colors: FloatArray, weight: FloatArray) -> FloatArray:
    """(n, 3) of colours (n, 3): what follows the direction of the surface as light does, by robust least squares."""
    shape = harmonics(normals)[:, 1:]
    if not weight.any():
        return np.zeros_like(colors)
    shape = shape - np.average(shape, axis=0, weights=weight)
    centred = np.column_stack([np.ones(len(shape)), shape])
    ridge = np.diag([0.0, *[_RIDGE] * 8]) * weight.sum()
    robust = weight
    solution = np.zeros((9, 3))
    for _ in range(5):
        rows = centred * robust[:, None]
        solution = np.linalg.solve(rows.T @ centred + ridge, rows.T @ colors)
        off = np.abs((colors - centred @ solution) @ GREY)
        robust = weight / (1 + (off / _OUTLIER) ** 2)
    return np.asarray(shape @ solution[1:])


def is_skin(skin: SkinSurface, colors: FloatArray, trust: FloatArray) -> FloatArray:
    """(n,) 0..1, what of colours (n, 3) are skin: not hair, glasses, clothes, hands or what is behind.

    What is far from the median colour of the face is no skin, nor are patches that hang together with the face through
    it alone.
    """
    face = inner(skin)
    weight = trust * skin.areas * face
    if not weight.any():
        return np.zeros(len(trust))
    levels = np.column_stack([colors @ GREY, colors[:, 0] - colors[:, 1], colors[:, 2] - colors[:, 1]])
    square = np.zeros(len(trust))
    for level, (least, most) in zip(levels.T, _LEVELS, strict=True):
        off = np.abs(level - quantile(level, weight, 0.5))
        square += (off / np.clip(1.5 * quantile(off, weight, 0.5), least, most)) ** 2
    far = skin.smooth(np.sqrt(square)[:, None], trust, _GRAIN)[:, 0]
    strange = (trust > 0) & (far > _STRANGE[0] + (_STRANGE[1] - _STRANGE[0]) * face)
    certain: FloatArray = np.ones(len(trust))
    if strange.any():
        distance = cKDTree(skin.points[strange]).query(skin.points)[0]
        certain = step(distance / skin.eye_distance(skin.points), *_EDGE)
    return certain * _joined(skin, certain * trust > _FAINT, weight)


def _joined(skin: SkinSurface, certain: BoolArray, weight: FloatArray) -> FloatArray:
    """(n,) the connected part of certain points with the most weight (n,), and the uncertain ones."""
    inside = certain[skin.edges].all(axis=1)
    part = components(len(certain), skin.edges[inside])
    main = np.bincount(part, weight * certain).argmax()
    return np.asarray(~certain | (part == main), np.float64)


def one_sided(skin: SkinSurface, colors: FloatArray, trust: FloatArray) -> FloatArray:
    """(n, 3) what of colours (n, 3) differs widely from the other side of the face."""
    other, known = skin.other_side(colors, trust)
    total = trust + known
    both = (trust[:, None] * colors + known[:, None] * other) / np.maximum(total[:, None], 1e-9)
    return skin.smooth(colors, trust, _WIDE) - skin.smooth(both, total, _WIDE)


def quantile(values: FloatArray, weight: FloatArray, share: float) -> float:
    """The quantile of values (n,) by weights (n,), 0 where all of these are."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(sums, share * sums[-1])]) if sums[-1] > 0 else 0.0
