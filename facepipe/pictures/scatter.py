"""Light that scatters below a surface and leaves it a little away: a blur of diffuse light, within one surface.

Screen-space subsurface scattering in the manner of Jimenez et al. 2015, with one profile for all colours; how much of
each colour goes that way is up to the caller.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

_CELLS = 2.0  # in a standard deviation of the blur: finer detail of its result has no meaning


def spread(light: Floats, share: Floats, depth: Floats, width: float, focal: float) -> Floats:
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
    values = np.dstack([light, share, depth])
    coarse = _pooled(values, cell)
    blurred = _blurred(coarse, pixels / cell, width)
    inside = coarse[..., 3:4] > 0
    change = blurred - coarse[..., :3] / np.where(inside, coarse[..., 3:4], 1)
    return _enlarged(np.where(inside, change, 0).astype(np.float32), cell, light.shape[:2])


def _blurred(values: Floats, sigma: float, width: float) -> Floats:
    """(h, w, 3) light blurred along rows, then columns, over neighbours at about the same depth."""
    depth = values[..., 4] / np.where(values[..., 3] > 0, values[..., 3], 1)
    summed = values[..., :4]
    reach = int(np.ceil(2.5 * sigma))
    for axis in (0, 1):
        total = np.zeros_like(summed)
        for step in range(-reach, reach + 1):
            to, source = _shifted(axis, step, depth.shape)
            apart = (depth[source] - depth[to]) / width
            weight = np.exp(np.float32(-((step / sigma) ** 2) / 2) - apart * apart)
            total[to] += summed[source] * weight[..., None]
        summed = total
    return np.asarray(summed[..., :3] / np.where(summed[..., 3:] > 0, summed[..., 3:], 1))


def _shifted(axis: int, step: int, shape: tuple[int, ...]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Where values that move by `step` go, and where they come from."""
    size = shape[axis]
    to, source = [slice(None)] * 2, [slice(None)] * 2
    to[axis] = slice(max(0, -step), max(0, min(size, size - step)))
    source[axis] = slice(max(0, step), max(0, min(size, size + step)))
    return tuple(to), tuple(source)


def _pooled(values: Floats, cell: int) -> Floats:
    """Sums over square cells; those at the far borders may be smaller."""
    rows, columns = (-(-side // cell) for side in values.shape[:2])
    padded = np.zeros((rows * cell, columns * cell, values.shape[2]), np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(rows, cell, columns, cell, -1).sum(axis=(1, 3)))


def _enlarged(values: Floats, cell: int, shape: tuple[int, int]) -> Floats:
    """Cells as pixels (h, w, c) of `shape`, blended between the cells' middles."""
    for axis in (0, 1):
        at = np.clip((np.arange(shape[axis], dtype=np.float32) + 0.5) / cell - 0.5, 0, values.shape[axis] - 1)
        low = at.astype(np.int64)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1)).astype(np.float32)
        values = values.take(low, axis=axis) * (1 - share) + values.take(high, axis=axis) * share
    return values
