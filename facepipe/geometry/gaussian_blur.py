"""Gaussian filters of pictures, strip by strip: an eighth to a third of the time of scipy.ndimage.gaussian_filter."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_ROWS, _COLUMNS = 32, 64  # that a product with a matrix of weights makes, all of it in the cache
_TRUNCATED = 4.0  # standard deviations that the kernel reaches, as scipy's does


def gaussian_blur(picture: FloatArray, sigmas: float | tuple[float, float]) -> FloatArray:
    """A picture (h, w) filtered along both axes, float32; beyond its edges it is mirrored.

    scipy's result to 4e-7 of the largest value: it sums in float64.

    :param sigmas: standard deviation in pixels, down and across where they differ
    """
    down, across = sigmas if isinstance(sigmas, tuple) else (sigmas, sigmas)
    (above, columns), (beside, rows) = _weights(down, _ROWS), _weights(across, _COLUMNS)
    height, width = picture.shape
    values, result = np.asarray(picture, np.float32), np.empty((height, width), np.float32)
    # the places that mirrored edges show; the picture is not copied whole with them
    lines, places = (np.pad(np.arange(n), r, mode="symmetric") for n, r in ((height, above), (width, beside)))
    strip = np.empty((_ROWS, width + 2 * beside), np.float32)
    for top in range(0, height, _ROWS):
        count = min(_ROWS, height - top)
        inside = above <= top and top + count + above <= height
        shown = values[slice(top - above, top + count + above) if inside else lines[top : top + count + 2 * above]]
        middle = strip[:count, beside : beside + width]
        np.matmul(columns[: count + 2 * above, :count].T, shown, out=middle)
        strip[:count, :beside] = middle[:, places[:beside]]
        strip[:count, beside + width :] = middle[:, places[beside + width :]]
        for left in range(0, width, _COLUMNS):
            wide = min(_COLUMNS, width - left)
            made = result[top : top + count, left : left + wide]
            np.matmul(strip[:count, left : left + wide + 2 * beside], rows[: wide + 2 * beside, :wide], out=made)
    return result


def _weights(sigma: float, places: int) -> tuple[int, FloatArray]:
    """How far a kernel reaches, and (places + 2 reach, places) its weights for each of some places in a row."""
    reach = int(_TRUNCATED * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights = np.zeros((places + 2 * reach, places), np.float32)
    for place in range(places):
        weights[place : place + 2 * reach + 1, place] = kernel / kernel.sum()
    return reach, weights
