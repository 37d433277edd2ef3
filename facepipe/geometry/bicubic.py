"""Pictures at another size, bicubic, a strip of rows at a time: as Pillow's filter makes them whole in 4 to 10 times as
long, most of it for new memory.

Both passes are products with matrices of a few rows of weights, which the caches hold (2 ms for 2048 x 2048).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray

ROWS = 32  # of a strip
_COLUMNS = 128
_SHARPNESS = -0.5  # of the cubic: Catmull and Rom's

_Block = tuple[slice, slice, FloatArray]  # places of the result, those of the picture that they are of, and weights


def strips(size: int) -> list[slice]:
    """Rows of a picture of `size`, some at a time: whole pictures took twice as long, for page faults."""
    return [slice(top, min(top + ROWS, size)) for top in range(0, size, ROWS)]


class Enlarged:
    """A picture (h, w) at (size, size), float32; its rows are made when they are asked for.

    As Pillow's bicubic filter has it to 4e-7 of the largest value, which makes smaller ones too.
    """

    def __init__(self, picture: Any, size: int) -> None:
        """:param picture: (h, w) numbers"""
        values = np.asarray(picture, np.float32)
        height, width = values.shape
        self._down = _blocks(height, size, ROWS)
        if width == size:
            self._wide: FloatArray = values
            return
        self._wide = np.empty((height, size), np.float32)
        for to, of, weights in _blocks(width, size, _COLUMNS):
            np.matmul(values[:, of], weights.T, out=self._wide[:, to])

    def __getitem__(self, rows: slice) -> FloatArray:
        """(rows, size) one of the `strips`."""
        if len(self._wide) == self._wide.shape[1]:
            return self._wide[rows]
        _, of, weights = self._down[rows.start // ROWS]
        return np.asarray(weights @ self._wide[of])

    def whole(self) -> FloatArray:
        """(size, size), new."""
        size = self._wide.shape[1]
        result = np.empty((size, size), np.float32)
        for rows in strips(size):
            result[rows] = self[rows]
        return result


@cache
def _blocks(count: int, size: int, places: int) -> tuple[_Block, ...]:
    """The products that make `size` places of `count`, so many places in each."""
    ratio = count / size
    scale = max(ratio, 1.0)
    middles = (np.arange(size) + 0.5) * ratio
    first = np.maximum((middles - 2 * scale + 0.5).astype(int), 0)
    after = np.minimum((middles + 2 * scale + 0.5).astype(int), count)
    taps = first[:, None] + np.arange((after - first).max())
    weights = np.where(taps < after[:, None], _cubic((taps + 0.5 - middles[:, None]) / scale), 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    found = []
    for start in range(0, size, places):
        own = slice(start, min(start + places, size))
        of = slice(int(first[own].min()), int(after[own].max()))
        block = np.zeros((own.stop - start, of.stop - of.start), np.float32)
        row, column = np.nonzero(taps[own] < after[own, None])
        block[row, taps[own][row, column] - of.start] = weights[own][row, column]
        found.append((own, of, block))
    return tuple(found)


def _cubic(away: FloatArray) -> FloatArray:
    x, a = np.abs(away), _SHARPNESS
    near, far = ((a + 2) * x - (a + 3)) * x * x + 1, (((x - 5) * x + 8) * x - 4) * a
    return np.where(x < 1, near, np.where(x < 2, far, 0.0))
