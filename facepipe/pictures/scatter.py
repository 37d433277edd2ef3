"""Light that scatters below a surface and leaves it a little away: a blur of diffuse light, within one surface; and
shadows without grain.

Screen-space subsurface scattering in the manner of Jimenez et al. 2015, with one profile for all colours; how much of
each colour goes that way is up to the caller.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import Float32Array

_RINGS = (0.35, 1.0)  # of the width of hollows
_COMPASS = ((0.0, 1.0), (0.7, 0.7), (1.0, 0.0), (0.7, -0.7))
_HOLLOW = 0.95  # of the light; how dark the deepest hollow is
_CELLS = 2.0  # in a standard deviation of the blur: finer detail of its result has no meaning


def spread(light: Float32Array, share: Float32Array, depth: Float32Array, width: float, focal: float) -> Float32Array:
    """(h, w, 3) what scattering adds to diffuse light; negative where it takes some away.

    :param light: (h, w, 3) diffuse light, premultiplied by `share`
    :param share: (h, w) of each pixel that surfaces cover
    :param depth: (h, w) along the view, premultiplied by `share`
    :param width: standard deviation of the blur, in units of depth
    :param focal: pixels
    """
    covered = float(share.sum())
    pixels = width * focal * covered / max(float(depth.sum()), 1e-12)
    if covered == 0 or pixels < 0.5:
        return np.zeros_like(light)
    cell = max(1, round(pixels / _CELLS))
    coarse = _pooled(np.dstack([light, share, depth]), cell)
    values, far = coarse[..., :4], _mean(coarse[..., 4], coarse[..., 3])
    steps = np.arange(np.ceil(2.5 * pixels / cell) + 1, dtype=np.float32)
    blurred = _blurred(values, far, np.exp(-((steps * cell / pixels) ** 2) / 2), width)
    change = blurred - _mean(coarse[..., :3], coarse[..., 3:4])
    return _enlarged(np.where(coarse[..., 3:4] > 0, change, 0).astype(np.float32), cell, light.shape[:2])


def smoothed(values: Float32Array, share: Float32Array, depth: Float32Array, focal: float) -> Float32Array:
    """(h, w) values without the grain of single pixels: means over 5 by 5 of them at about the same depth.

    :param values: (h, w) premultiplied by `share`, as `depth` is; see `spread`
    """
    far = _mean(depth, share)
    return _blurred(np.dstack([values, share]), far, np.ones(3, np.float32), 8 * float(far.max()) / focal)[..., 0]


def _blurred(values: Float32Array, depth: Float32Array, weights: Float32Array, width: float) -> Float32Array:
    """(h, w, c) values, the last of which is their share, blurred along rows, then columns, where the depth is alike.

    :param weights: of neighbours 0, 1, 2 ... pixels away
    """
    for axis in (0, 1):
        total = values * weights[0]
        for step in range(1, len(weights)):
            lower, upper = (
                tuple(each if other == axis else slice(None) for other in (0, 1))
                for each in (slice(0, -step), slice(step, None))
            )
            apart = (depth[lower] - depth[upper]) / np.float32(width)
            alike = (weights[step] * np.exp(-apart * apart))[..., None]
            total[lower] += values[upper] * alike
            total[upper] += values[lower] * alike
        values = total
    return _mean(values[..., :-1], values[..., -1:])


def _mean(values: Float32Array, share: Float32Array) -> Float32Array:
    return np.asarray(values / np.where(share > 0, share, 1))


def _pooled(values: Float32Array, cell: int) -> Float32Array:
    """Sums over square cells; those at the far borders may be smaller."""
    rows, columns = (-(-side // cell) for side in values.shape[:2])
    padded = np.zeros((rows * cell, columns * cell, values.shape[2]), np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(rows, cell, columns, cell, -1).sum(axis=(1, 3)))


def _enlarged(values: Float32Array, cell: int, shape: tuple[int, int]) -> Float32Array:
    """Cells as pixels (h, w, c) of `shape`, blended between the cells' middles."""
    for axis in (0, 1):
        at = np.clip((np.arange(shape[axis], dtype=np.float32) + 0.5) / cell - 0.5, 0, values.shape[axis] - 1)
        low = at.astype(np.int64)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1)).astype(np.float32)
        values = values.take(low, axis=axis) * (1 - share) + values.take(high, axis=axis) * share
    return values


def open_share(depth: Float32Array, share: Float32Array, width: float, focal: float) -> Float32Array:
    """(h, w) share of soft light that reaches places between nearer ones: eyes under lids, lips on each other.

    Pairs of opposite neighbours rise above a place only where it lies in a hollow, however the surface is inclined.

    :param depth: (h, w) along the view, premultiplied by `share`
    :param width: of the hollows, in units of depth
    """
    far = np.where(share > 0, _mean(depth, share), np.finfo(np.float32).max / 4)
    covered = float(share.sum())
    pixels = width * focal * covered / max(float(depth.sum()), 1e-12)
    hidden = np.zeros_like(far)
    for part in _RINGS:
        reach = np.float32(part * width)
        steps = {(round(part * pixels * y), round(part * pixels * x)) for y, x in _COMPASS} - {(0, 0)}
        for down, right in steps:
            heights = [np.clip(far - _moved(far, y, x), -reach, reach) for y, x in ((down, right), (-down, -right))]
            hidden += np.maximum(heights[0] + heights[1], 0) / (2 * reach * len(_COMPASS) * len(_RINGS))
    return np.asarray(1 - _HOLLOW * hidden, np.float32)


def _moved(values: Float32Array, down: int, right: int) -> Float32Array:
    """(h, w) of each pixel the value `down` and `right` of it, at the borders the nearest one."""
    rows = np.clip(np.arange(values.shape[0]) + down, 0, values.shape[0] - 1)
    columns = np.clip(np.arange(values.shape[1]) + right, 0, values.shape[1] - 1)
    return np.asarray(values[rows][:, columns])
