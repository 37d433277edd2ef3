"""Photos registered to one another on the surface: optical flow in texture coordinates.

Lucas & Kanade, An Iterative Image Registration Technique with an Application to Stereo Vision, 1981, from coarse to
fine. A window's displacement d minimises sum(w (I0(x) - I1(x + d))^2) + ridge |d|^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.geometry.texels import Texels
from facepipe.textures.observed import GREY, Observed

# all lengths are shares of the eyes' distance
_AROUND = 0.15  # what brightness is compared with
_WINDOW = 0.05  # deviation
_FARTHEST = 0.06  # displacement
_COARSEST, _FINEST = 128, 512  # texels a side of levels: displacements are smooth
_STEPS = 4  # at each level
_UNLIKE = 0.25  # of a logarithm: colours that differ so hardly count
_RIDGE = 25.0  # square of a logarithm over that of a length: windows with less of a gradient stay where they are
_FAINT = 1e-3  # confidence


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
    return _moved(texels, other, flat, _flow(*both, texel))


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
        flow = flow + _step(first, other, flow, texel)
        flow = flow * np.minimum(1, _FARTHEST / texel / np.maximum(np.hypot(*flow), 1e-9))
    return flow


def _step(first: _Level, other: _Level, flow: FloatArray, texel: float) -> FloatArray:
    """What is to be added to a displacement."""
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
    return np.asarray(np.stack([yy * xr - xy * yr, xx * yr - xy * xr]) / (xx * yy - xy**2))


def _moved(texels: Texels, one: Observed, flat: FloatArray, flow: FloatArray) -> Observed:
    """What a photo shows at displaced places, by the colours that it has there."""
    shown = one.ratio + np.log(flat[one.place])
    values = _picture(texels, one, np.column_stack([shown * one.trust[:, None], one.trust]))
    row, column = np.divmod(texels.at, texels.size)
    at = np.stack([row, column]) + flow[:, row, column]
    *colors, trust = (map_coordinates(each, at, order=1, mode="constant") for each in values)
    place = np.flatnonzero(trust > _FAINT)
    ratio = np.stack(colors, axis=1)[place] / trust[place, None] - np.log(flat[place])
    return Observed(place=place, ratio=ratio.astype(np.float32), trust=trust[place])
