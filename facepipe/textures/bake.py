"""Textures of the skin from photos: observed, evened, merged by confidence, and completed.

Colours are natural logarithms of ratios to the template's throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from facepipe.core.arrays import ByteArray, Float32Array, FloatArray
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.texels import Texels, spread
from facepipe.textures.evened import (
    balance,
    inner,
    is_skin,
    missed_light,
    one_sided,
    quantile,
    relief,
    renewed,
    too_dark,
    upper_lids,
)
from facepipe.textures.hair import hair_color, scalp_color
from facepipe.textures.seen_skin import DARKEST, GREY, Exposure, Observed, observe
from facepipe.textures.skin_surface import SkinSurface, template_texels

# all lengths are shares of the eyes' distance
_AROUND = 0.15  # what brightness is compared with
_WINDOW = 0.05  # deviation
_FARTHEST = 0.06  # displacement
_COARSEST, _FINEST = 128, 512  # texels a side of levels: displacements are smooth
_STEPS = 4  # at each level
_UNLIKE = 0.25  # of a logarithm: colours that differ so hardly count
_RIDGE = 25.0  # square of a logarithm over that of a length: windows with less of a gradient stay where they are
_FAINT = 1e-3  # confidence
# all lengths are shares of the eyes' distance
_REACH = 0.02  # of the completion: what is smaller is detail
_FAR = 0.15  # over which what is unseen goes to the skin's median colour
_INSIDE = 0.15  # over which the mouth's inside and the sockets go to the template's own colour
_SHARP = 4  # power of preference by which photos are mixed: mostly one in one place, where features would blur
_FOLDED = 0.6  # of the confidence in lids, that goes: a blink stretches what of their skin an open eye shows
_STRAINED = 0.5  # of preference that goes where a photo's expression folds the skin
_OTHERS = 0.8  # preference of all photos but the one that shows the face best: features fit together in one photo


@dataclass(frozen=True, kw_only=True)
class _Level:
    """A brightness, less what is around it, and confidence in it, both (s, s)."""

    bright: FloatArray
    trust: FloatArray

    def halved(self) -> _Level:
        """The same in texels twice as wide."""
        trust = _quarters(self.trust)
        bright = _quarters(self.bright * self.trust) / np.maximum(trust, _FAINT)
        return _Level(bright=bright, trust=trust / 4)


def _quarters(picture: FloatArray) -> FloatArray:
    """(s // 2, s // 2) sums of four."""
    half = picture.shape[0] // 2
    return np.asarray(picture[: 2 * half, : 2 * half].reshape(half, 2, half, 2).sum(axis=(1, 3)))


def registered(texels: Texels, first: Observed, other: Observed, flat: FloatArray, texel: float) -> Observed:
    """What another photo shows, moved along the texture to where the first shows the same.

    :param flat: (m, 3) linear colours of the template's texels
    :param texel: width of one, in shares of the eyes' distance
    """
    both = _level(texels, first, flat, texel), _level(texels, other, flat, texel)
    flow = _flow(*both, texel)
    shown = other.ratio + np.log(flat[other.place])
    values = _picture(texels, other, np.column_stack([shown * other.trust[:, None], other.trust]))
    row, column = np.divmod(texels.at, texels.size)
    at = np.stack([row, column]) + flow[:, row, column]
    *colors, trust = (map_coordinates(each, at, order=1, mode="constant") for each in values)
    place = np.flatnonzero(trust > _FAINT)
    ratio = np.stack(colors, axis=1)[place] / trust[place, None] - np.log(flat[place])
    return Observed(place=place, ratio=ratio.astype(np.float32), trust=trust[place])


def _level(texels: Texels, one: Observed, flat: FloatArray, texel: float) -> _Level:
    values = np.column_stack([(one.ratio + np.log(flat[one.place])) @ GREY, one.trust])
    bright, trust = _picture(texels, one, values)
    reach = _AROUND / texel
    around = gaussian_filter(bright * trust, reach) / np.maximum(gaussian_filter(trust, reach), _FAINT)
    return _Level(bright=np.where(trust > 0, bright - around, 0), trust=trust)


def _picture(texels: Texels, one: Observed, values: FloatArray) -> Float32Array:
    """(c, size, size) of values (k, c), 0 beside them."""
    picture = np.zeros((values.shape[1], texels.size**2), np.float32)
    picture[:, texels.at[one.place]] = values.T
    return picture.reshape(-1, texels.size, texels.size)


def _flow(first: _Level, other: _Level, texel: float) -> FloatArray:
    """(2, s, s) rows and columns by which what the first shows lies farther on in the other."""
    side = first.bright.shape[0]
    flow: FloatArray = np.zeros((2, side, side))
    if side > _COARSEST:
        coarse = _flow(first.halved(), other.halved(), 2 * texel)
        flow = 2 * np.stack([zoom(part, 2, order=1, mode="nearest", grid_mode=True) for part in coarse])
        flow = np.pad(flow, ((0, 0), *[(0, side - flow.shape[1])] * 2), mode="edge")
    for _ in range(_STEPS if side <= _FINEST else 0):
        at = np.indices(first.bright.shape, np.float32) + flow
        there, seen = (map_coordinates(each, at, order=1, mode="nearest") for each in (other.bright, other.trust))
        weight = first.trust * seen * (np.minimum(first.trust, seen) > _FAINT)
        off = first.bright - there
        weight = weight / (1 + (off / _UNLIKE) ** 2)
        down, right = np.gradient((first.bright + there) / 2)
        down, right = (np.where(weight > 0, each, 0) for each in (down, right))
        xx, xy, yy, xr, yr = (
            gaussian_filter(weight * one * two, _WINDOW / texel)
            for one, two in ((down, down), (down, right), (right, right), (down, off), (right, off))
        )
        ridge = _RIDGE * texel**2 * gaussian_filter(weight, _WINDOW / texel) + 1e-12
        xx, yy, xr, yr = xx + ridge, yy + ridge, xr - ridge * flow[0], yr - ridge * flow[1]
        flow = flow + np.asarray(np.stack([yy * xr - xy * yr, xx * yr - xy * xr]) / (xx * yy - xy**2))
        flow = flow * np.minimum(1, _FARTHEST / texel / np.maximum(np.hypot(*flow), 1e-9))
    return flow


@dataclass(frozen=True, kw_only=True)
class Baked:
    """Textures of the skin."""

    pictures: tuple[ByteArray, ...]  # of each (size, size, 3) sRGB
    scales: tuple[FloatArray, ...]  # (3,) of each photo's light
    lights: tuple[FloatArray, ...]  # (9, 3) harmonics of each photo under which the textures look as it does
    shares: tuple[float, ...]  # of the face that each photo shows
    seen: float  # share of the face that some photo shows
    trust: FloatArray  # (n,) the most confidence that a photo has at each point
    skin: FloatArray  # (3,) linear colour of the face
    hair: FloatArray | None  # (3,) linear colour, where photos show it


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """One photo's colours of the skin."""

    observed: tuple[Observed, ...]  # of each texture
    colors: FloatArray  # (n, 3) at points
    trust: FloatArray  # (n,)
    calm: FloatArray  # (n, 1) preference before other photos of as much confidence, 0..1
    scale: FloatArray  # (3,) of its light
    light: FloatArray  # (9, 3) its harmonics


class Baker:
    """The textures of one skin as they are to be baked over."""

    def __init__(self, skin: SkinSurface) -> None:
        self.skin = skin
        self.flats = [np.maximum(template_texels(texture), DARKEST) for texture in skin.textures]
        sums = np.zeros((len(skin.points), 4))
        for texture, flat in zip(skin.textures, self.flats, strict=True):
            for run, part in texture.texels.runs():
                own = np.log(flat[run])
                sums += part.summed(np.column_stack([own, np.ones(len(own))]), len(skin.points))
        self.lids = upper_lids(skin)
        self.totals = sums[:, 3]
        self.template = sums[:, :3] / np.maximum(self.totals, 1e-9)[:, None]  # at points

    def __call__(self, photos: Sequence[Exposure], scalp: FloatArray | None = None, *, bald: bool = False) -> Baked:
        """Textures from photos, one or more.

        :param scalp: (n,) how far points are painted with hair, whose colour photos show
        :param bald: the scalp has the skin's colour instead
        """
        layers = self._ranked(photos, self._alike([self._layer(photo) for photo in photos]))
        # (3,) linear, the median of the face in the first photo
        weight = layers[0].trust * self.skin.areas * inner(self.skin)
        own = np.exp([quantile(channel, weight, 0.5) for channel in (self.template + layers[0].colors).T])
        color = paint = None
        if scalp is not None and not bald:
            color = hair_color(photos, [layer.scale for layer in layers], scalp)
        if scalp is not None and (bald or color is not None):
            below = own if color is None else scalp_color(color, own)
            paint = scalp[:, None], scalp[:, None] * (np.log(below) - self.template)
        merged = [self._merged(number, layers) for number in range(len(self.flats))]
        colors, trust = self.at_points(merged)
        whole, pictures = self.completed(colors, trust, paint), []
        for texture, flat, one in zip(self.skin.textures, self.flats, merged, strict=True):
            levels = np.empty(flat.shape, np.uint8)
            for run, part in texture.texels.runs():
                ratio = part.carried(whole)
                seen = slice(*np.searchsorted(one.place, (run.start, run.stop)))
                place = one.place[seen] - run.start
                ratio[place] += one.trust[seen, None] * (one.ratio[seen] - part.taken(place).carried(colors))
                levels[run] = to_srgb(np.exp(ratio) * flat[run]) * 255 + 0.5
            pictures.append(spread(texture.texels, levels))
        face = inner(self.skin) * self.skin.areas * self.skin.outside
        seen = np.max([layer.trust for layer in layers], axis=0)
        return Baked(
            pictures=tuple(pictures),
            scales=tuple(layer.scale for layer in layers),
            lights=tuple(layer.light for layer in layers),
            shares=tuple(float(layer.trust @ face / face.sum()) for layer in layers),
            seen=float(seen @ face / face.sum()),
            trust=seen,
            skin=own,
            hair=color,
        )

    def _layer(self, photo: Exposure) -> _Layer:
        skin = self.skin
        observed = [observe(skin, photo, number, flat) for number, flat in enumerate(self.flats)]
        colors, trust = self.at_points(observed)
        raw = colors
        light = missed_light(photo.normals, colors, trust * skin.areas * inner(skin))
        mask = is_skin(skin, colors - light, trust)
        trust = trust * mask
        light = light + one_sided(skin, colors - light, trust)
        light = light + too_dark(skin, colors - light, trust, self.lids)
        around = relief(skin, photo, colors - light, trust)
        shown = self.template + colors - light
        weight = trust * skin.areas * inner(skin)
        scale = balance(photo, np.exp([quantile(channel, weight, 0.5) for channel in shown.T]))
        kept = mask * (1 - _FOLDED * self.lids)
        observed = [self.evened(number, one, light, kept) for number, one in enumerate(observed)]
        lessened = []
        for texture, one in zip(skin.textures, observed, strict=True):
            ratio = one.ratio - around.too_much(texture.texels.taken(one.place), one.ratio)
            lessened.append(replace(one, ratio=np.asarray(ratio - np.log(scale), np.float32)))
        colors, trust = self.at_points(lessened)
        white = photo.white * np.exp(raw - colors)
        harmonics = renewed(photo, white, trust * skin.areas, scale)
        calm = (1 - _STRAINED * around.folds) * np.clip(photo.facing, 0.0, 1.0)[:, None]
        return _Layer(observed=tuple(lessened), colors=colors, trust=trust, calm=calm, scale=scale, light=harmonics)

    def at_points(self, observed: Sequence[Observed]) -> tuple[FloatArray, FloatArray]:
        """(n, 3) mean colours at points, and (n,) confidence."""
        sums = np.zeros((len(self.skin.points), 4))
        for texture, one in zip(self.skin.textures, observed, strict=True):
            for run, part in texture.texels.taken(one.place).runs():
                trust = one.trust[run]
                values = np.column_stack([one.ratio[run] * trust[:, None], trust])
                sums += part.summed(values, len(self.skin.points))
        return sums[:, :3] / np.maximum(sums[:, 3:], 1e-9), sums[:, 3] / np.maximum(self.totals, 1e-9)

    def evened(self, number: int, one: Observed, light: FloatArray, mask: FloatArray) -> Observed:
        """What was observed of a texture, less light (n, c) at points, where a mask (n,) leaves something."""
        part = self.skin.textures[number].texels.taken(one.place)
        trust = one.trust * part.carried(mask[:, None])[:, 0]
        kept = np.flatnonzero(trust > 0)
        ratio = np.take(one.ratio - part.carried(light), kept, axis=0)
        return Observed(place=one.place[kept], ratio=ratio, trust=trust[kept])

    def _alike(self, layers: Sequence[_Layer]) -> list[_Layer]:
        """Layers as bright, and of the hue, that all have in the mean: how a photo's light is balanced is a guess."""
        first = max(layers, key=lambda layer: float(layer.trust @ self.skin.areas))
        offs = []  # (3,) by how much the first is brighter where both show skin
        for layer in layers:
            weight = first.trust * layer.trust * self.skin.areas
            offs.append(np.array([quantile(channel, weight, 0.5) for channel in (first.colors - layer.colors).T]))
        alike = []
        for layer, own in zip(layers, offs, strict=True):
            off = own - np.mean(offs, axis=0)
            observed = tuple(replace(one, ratio=one.ratio + off.astype(np.float32)) for one in layer.observed)
            scale, light = (each * np.exp(-off) for each in (layer.scale, layer.light))
            alike.append(replace(layer, observed=observed, colors=layer.colors + off, scale=scale, light=light))
        return alike

    def _ranked(self, photos: Sequence[Exposure], layers: Sequence[_Layer]) -> list[_Layer]:
        """Layers of which the one that shows the face best is preferred: much of it, large, and well lit."""
        face = inner(self.skin) * self.skin.areas
        shown = [float(layer.trust * layer.calm[:, 0] @ face) for layer in layers]
        best = int(np.argmax([share * photo.clarity for share, photo in zip(shown, photos, strict=True)]))
        ranked = list(layers)
        for number, layer in enumerate(layers):
            if number == best:
                continue
            observed = []  # the others' features, brought to where the best has them
            for texture, flat, one, other in zip(
                self.skin.textures, self.flats, layers[best].observed, layer.observed, strict=True
            ):
                texel = float(np.sqrt(self.skin.areas.sum() / len(texture.texels.at)))
                observed.append(registered(texture.texels, one, other, flat, texel))
            colors, trust = self.at_points(observed)
            calm = _OTHERS * layer.calm
            ranked[number] = replace(layer, observed=tuple(observed), colors=colors, trust=trust, calm=calm)
        return ranked

    def _merged(self, number: int, layers: Sequence[_Layer]) -> Observed:
        if len(layers) == 1:
            return layers[0].observed[number]
        count = len(self.flats[number])
        sums, weights, most = np.zeros((count, 3), np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
        for layer in layers:
            one = layer.observed[number]
            calm = self.skin.textures[number].texels.taken(one.place).carried(layer.calm)[:, 0]
            weight = np.maximum(one.trust * calm, 1e-3) ** _SHARP
            sums[one.place] += weight[:, None] * one.ratio
            weights[one.place] += weight
            most[one.place] = np.maximum(most[one.place], one.trust)
        place = np.flatnonzero(weights > 0)
        return Observed(place=place, ratio=sums[place] / weights[place, None], trust=most[place])

    def completed(
        self, colors: FloatArray, trust: FloatArray, paint: tuple[FloatArray, FloatArray] | None = None
    ) -> FloatArray:
        """(n, 3) colours of all points: those seen, and what continues them without a step where none is.

        Gradients there are those of the other side of the face where that is seen, else the template's own. Far off
        and inside mouth and sockets, colours go to the median of what is seen, and to the template's.

        :param paint: shares (n, 1) of other colours that unseen points go to, and these times their shares
        """
        skin = self.skin
        other, known = skin.other_side(colors, trust)
        weight = trust * skin.areas * inner(skin)
        middle = np.array([quantile(channel, weight, 0.5) for channel in colors.T])
        pull = np.where(skin.outside, (1 - trust) * (_REACH / _FAR) ** 2, (_REACH / _INSIDE) ** 2)
        target = np.where(skin.outside[:, None], middle, 0.0)
        if paint is not None:
            target = target * (1 - paint[0]) + paint[1]

        def whole(values: FloatArray, weights: FloatArray, rest: FloatArray) -> FloatArray:
            total = weights + pull
            mixed = (weights[:, None] * values + pull[:, None] * rest) / np.maximum(total, 1e-12)[:, None]
            return skin.smooth(mixed, total, _REACH)

        guide = whole(other, known, target)
        return guide + whole(colors - guide, trust, target - guide)
