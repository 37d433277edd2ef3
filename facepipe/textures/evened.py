"""Which of a photo's colours are skin, and what of them is light that the fit has missed: by robust statistics.

Colours are natural logarithms of ratios to the template's, at points. What varies with the direction of the surface, or
widely from one side of the face to the other, is light; true colours hardly do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.geometry.polygons import components
from facepipe.geometry.texels import Texels
from facepipe.heads.people import Look
from facepipe.pictures.lighting import harmonics
from facepipe.textures.seen_skin import GREY, Exposure, step
from facepipe.textures.skin_surface import SkinSurface

# landmarks of the lips' outer rims, and those across from them
_LIPS_OUTER = [49, 50, 51, 52, 53, 55, 56, 57, 58, 59]
_LIPS_INNER = [61, 61, 62, 63, 63, 65, 65, 66, 67, 67]
# all lengths are shares of the eyes' distance
_INNER = (0.22, 0.45)  # off the landmarks inside the face: skin up to the first, anything beyond the second
_WIDE = 0.25  # over which both sides of a face are made alike
_UNEVEN = 0.5  # of what both sides vary over that, what is skin
_LOCAL = 0.10  # over which folds and hues stand out
_LEVELS = ((0.12, 0.35), (0.04, 0.10), (0.04, 0.10))  # least and largest deviation of skin: brightness, two hues
_LOWER = 0.05  # brows lie below their landmarks
_BROWS = (0.12, 0.18)  # off the arcs of the brows
_LIDS, _ABOVE_RIMS = (0.08, 0.16), (-0.02, 0.02)  # off the rims of the upper lids, where these begin and end
_THAN_BROWS = (0.7, 1.3)  # share of the distance off brows
_LASHES, _SHADE = 0.04, 0.25  # over which lids' shade varies; logarithm by which they may be darker than the face
_FOREHEAD, _BARE = (0.05, 0.09), 0.95  # above the brows; how far it is judged as what is beside the face
_CORE = (0.7, 1.0)  # of what `inner` gives: within the face, where nothing but glasses and hands hides skin
_STRANGE = (2.8, 30.0, 30.0)  # deviations beyond which a colour is no skin: beside the face, on it, more on brows
_EDGE = (0.02, 0.07)  # off what is no skin: where confidence begins, where it is full
_WIDER = 1.5  # by how much more beside the face
_GRAIN = 0.03  # what is smaller is judged with what is around it
_OUTLIER = 0.2  # of a logarithm
_RIDGE = 0.02
_FAINT = 0.3  # confidence that doesn't join patches of skin
_FOLD = 0.04  # that it may be darker
_STRANGE_HUE = 0.12  # logarithm by which skin differs from the hue around it at most
_FEATURES = (0.06, 0.12)  # off brows and lips: where skin begins, where all is skin
_STRAIN = (0.06, 0.25)  # logarithm of stretching: where folds begin to be the expression's, where they all are
_FLATTER = 0.75  # of an expression's folds, that goes
_BRIGHTEST = 1.1  # light of the brightest skin of a well exposed photo
_LIGHT_SPREAD, _SKIN_SPREAD = np.array([0.35, 0.12]), 0.1  # deviations: of brightness and hue of light, and of skin
_PAINTED = (0.6, 1.0)  # of a logarithm: hues of lids that are skin's in the shade, and those that are not
_WHITES, _WHITES_SPREAD = np.array([0.15, 0.0, 0.0]), np.array([0.35, 0.25])  # of eyes, between lids that redden them


def balance(photo: Exposure, skin_color: FloatArray) -> FloatArray:
    """(3,) factor of a photo's light that makes it and the skin likely.

    A photo shows their product alone, and a fit leaves the skin about as light as the template has it. But photos are
    exposed so that a face is well lit, and balanced so that light is white; and skin has few hues, those of Monk's
    tones. The mean of all tones by how likely they make the two. Whites of eyes tell of the light where they are seen.

    :param skin_color: (3,) linear, as the light of the stage gives it
    """
    bright = photo.white[photo.trust > _FAINT]
    if not len(bright):
        return np.ones(3)
    level = float(np.quantile(bright @ GREY, 0.9))
    mean = np.average(photo.white, axis=0, weights=photo.trust)
    stage = np.log(level * mean / float(mean @ GREY))
    shown = np.log(skin_color) + stage
    tones = np.log([Look(tone=tone).skin for tone in np.linspace(1.0, 10.0, 91)])
    # mean of the light of a photo, a logarithm, and variances of its brightness and hue: of all photos', and of what
    # the whites of eyes tell of this one's
    usual, spread = np.full((1, 3), np.log(_BRIGHTEST)), _LIGHT_SPREAD[:, None, None] ** 2
    if photo.eye_whites is not None:
        whites, other = stage + photo.eye_whites - _WHITES, _WHITES_SPREAD[:, None, None] ** 2
        mean = (_level_and_hue(usual) / spread + _level_and_hue(whites[None]) / other) / (1 / spread + 1 / other)
        usual, spread = mean.sum(axis=0), 1 / (1 / spread + 1 / other)
    parts = _level_and_hue(shown - tones - usual)
    cost = (parts**2 / (spread + _SKIN_SPREAD**2)).sum(axis=(0, 2))
    light = usual + (parts * spread / (spread + _SKIN_SPREAD**2)).sum(axis=0)
    likely = np.exp((cost.min() - cost) / 2)
    return np.asarray(np.exp(likely @ light / likely.sum() - stage))


def _level_and_hue(logarithms: FloatArray) -> FloatArray:
    """(2, n, 3) the means over the channels of (n, 3), and what is left."""
    level = np.repeat(logarithms.mean(axis=1, keepdims=True), 3, axis=1)
    return np.stack([level, logarithms - level])


def inner(skin: SkinSurface) -> FloatArray:
    """(n,) 1 on the face, 0 off it: hair, ears, neck."""
    marks = skin.points[skin.landmarks]
    cheeks = (marks[1:16] + marks[33]) / 2
    distance = cKDTree(np.concatenate([marks[17:], cheeks])).query(skin.points)[0]
    return 1 - step(distance / skin.eye_distance(skin.points), *_INNER)


def _forehead(skin: SkinSurface) -> tuple[FloatArray, FloatArray]:
    """(n,) 0..1, above the brows; (n,) distance from the arcs of the brows in shares of the eyes'."""
    marks, unit = skin.points[skin.landmarks], skin.eye_distance(skin.points)
    arcs = np.concatenate([marks[17:27], (marks[17:21] + marks[18:22]) / 2, (marks[22:26] + marks[23:27]) / 2])
    up = (marks[27] - marks[8]) / np.linalg.norm(marks[27] - marks[8])  # from the chin to the root of the nose
    arcs -= _LOWER * unit * up
    distance, nearest = cKDTree(arcs).query(skin.points)
    return step((skin.points - arcs[nearest]) @ up / unit, *_FOREHEAD), distance / unit


def renewed(photo: Exposure, white: FloatArray, weight: FloatArray, scale: FloatArray) -> FloatArray:
    """(9, 3) harmonics under which white points look as they do, beside the lamp: least squares, near those scaled.

    :param white: (n, 3) linear light that points show, of which the stage's light may lack some
    """
    dark = replace(photo.view, light=np.zeros((9, 3)))
    lamp = replace(photo.light, view=dark).white(photo.normals, photo.light.hidden, photo.light.arriving) * scale
    shape, before = harmonics(photo.normals) + photo.light.hidden, photo.view.light * scale
    rows = shape * weight[:, None]
    ridge = _RIDGE * np.trace(rows.T @ shape) / 9 * np.eye(9)
    return np.asarray(before + np.linalg.solve(rows.T @ shape + ridge, rows.T @ (white - lamp - shape @ before)))


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
    # deviations beyond which a colour is no skin: faces have lips, lashes and nostrils; foreheads are skin alone; brows
    # are hair that belongs there
    above, brows = _forehead(skin)
    outside, on_face, brow = _STRANGE
    limits = outside + (on_face - outside) * step(face, *_CORE) * (1 - _BARE * above)
    strange = (trust > 0) & (far > np.asarray(limits + brow * (1 - step(brows, *_BROWS)) * (1 - above)))
    certain: FloatArray = np.ones(len(strange))
    if strange.any():
        distance = cKDTree(skin.points[strange]).query(skin.points)[0]
        wide = 1 + _WIDER * (1 - face)
        certain = step(distance / skin.eye_distance(skin.points) / wide, *_EDGE)
    known = certain * trust > _FAINT
    inside = known[skin.edges].all(axis=1)
    part = components(len(known), skin.edges[inside])
    main = np.bincount(part, weight * known).argmax()
    return certain * np.asarray(~known | (part == main), np.float64)


def one_sided(skin: SkinSurface, colors: FloatArray, trust: FloatArray, uneven: float = _UNEVEN) -> FloatArray:
    """(n, 3) what of colours (n, 3) differs widely from the other side of the face, and some of what does from both.

    :param uneven: share of what both sides vary that is skin
    """
    other, known = skin.other_side(colors, trust)
    total = trust + known
    both = (trust[:, None] * colors + known[:, None] * other) / np.maximum(total[:, None], 1e-9)
    weight = trust * skin.areas * inner(skin)
    middle = np.array([quantile(channel, weight, 0.5) for channel in colors.T])
    even = middle + uneven * (skin.smooth(both, total, _WIDE) - middle)
    return np.asarray(skin.smooth(colors, trust, _WIDE) - even)


def upper_lids(skin: SkinSurface) -> FloatArray:
    """(n,) 0..1, 1 on upper lids, which open eyes fold away and brows shade: a blink shows all of them."""
    marks = skin.points[skin.landmarks]
    rims = np.concatenate([marks[[36, 37, 38, 39, 42, 43, 44, 45]], (marks[[37, 43]] + marks[[38, 44]]) / 2])
    up, unit = marks[27] - marks[8], skin.eye_distance(skin.points)
    distance, nearest = cKDTree(rims).query(skin.points)
    above = step((skin.points - rims[nearest]) @ up / np.linalg.norm(up) / unit, *_ABOVE_RIMS)
    nearer = 1 - step(distance / unit / np.maximum(_forehead(skin)[1], 1e-9), *_THAN_BROWS)
    return np.asarray(above * nearer * (1 - step(distance / unit, *_LIDS)))


def too_dark(skin: SkinSurface, colors: FloatArray, trust: FloatArray, lids: FloatArray) -> FloatArray:
    """(n, 1) what of colours (n, 3) is shade on upper lids (n,), whose skin is hardly darker than that of the face.

    What is of another hue than skin is paint, and stays.
    """
    weight = trust * skin.areas * inner(skin)
    off = skin.smooth(colors, trust, _LASHES) - [quantile(channel, weight, 0.5) for channel in colors.T]
    level = off @ GREY
    painted = step(np.linalg.norm(off - level[:, None], axis=1), *_PAINTED)
    return np.asarray((lids * (1 - painted) * np.minimum(level + _SHADE, 0))[:, None])


@dataclass(frozen=True, kw_only=True)
class Relief:
    """What a place of the skin is compared with."""

    level: FloatArray  # (n, 1) brightness around it
    hue: FloatArray  # (n, 3) colours around it, less brightness
    folds: FloatArray  # (n, 1) 0..1, how far folds are the expression's
    plain: FloatArray  # (n, 1) 0..1, 0 on brows and lips, which have colours of their own

    def too_much(self, texels: Texels, colors: FloatArray) -> FloatArray:
        """(m, 3) what of colours (m, 3) of texels is an expression's folds, and hues that skin has not."""
        grey, points = GREY.astype(np.float32), np.column_stack([self.level, self.folds, self.plain, self.hue])

        def of(part: Texels, colors: Float32Array) -> FloatArray:
            around = part.carried(points)
            level, folds, plain = (around[:, number : number + 1] for number in range(3))
            bright = (colors @ grey)[:, None]
            hue = colors - bright - around[:, 3:]
            dark = np.minimum(bright - level + _FOLD, 0) * folds
            return np.asarray(plain * (_FLATTER * dark + hue - np.clip(hue, -_STRANGE_HUE, _STRANGE_HUE)))

        return texels.by_runs(of, colors)


def relief(skin: SkinSurface, photo: Exposure, colors: FloatArray, trust: FloatArray) -> Relief:
    """Folds where an expression strains the skin, and strange hues, by colours (n, 3)."""
    level = (colors @ GREY)[:, None]
    smooth = skin.smooth(np.column_stack([level, colors - level]), trust, _LOCAL)
    around, hue = smooth[:, :1], smooth[:, 1:]
    points = photo.points
    # (n,) mean size of the logarithm of how edges stretch from the neutral to points (n, 3)
    ends = skin.edges.T
    posed, neutral = (np.linalg.norm(each[ends[0]] - each[ends[1]], axis=1) for each in (points, skin.points))
    stretch = np.abs(np.log(np.maximum(posed, 1e-9) / np.maximum(neutral, 1e-9)))
    sums, counts = np.zeros(len(points)), np.zeros(len(points))
    for end in ends:
        sums += np.bincount(end, stretch, minlength=len(points))
        counts += np.bincount(end, minlength=len(points))
    strained = skin.smooth(np.asarray(sums / np.maximum(counts, 1))[:, None], np.ones(len(trust)), _LOCAL)
    marks = skin.points[skin.landmarks]
    lips = np.concatenate([marks[48:68], (marks[_LIPS_OUTER] + marks[_LIPS_INNER]) / 2])
    off = cKDTree(lips).query(skin.points)[0] / skin.eye_distance(skin.points)
    plain = step(np.asarray(np.minimum(off, _forehead(skin)[1])), *_FEATURES)[:, None]
    return Relief(level=around, hue=hue, folds=step(strained, *_STRAIN), plain=plain)


def quantile(values: FloatArray, weight: FloatArray, share: float) -> float:
    """The quantile of values (n,) by weights (n,), 0 where all of these are."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(sums, share * sums[-1])]) if sums[-1] > 0 else 0.0
