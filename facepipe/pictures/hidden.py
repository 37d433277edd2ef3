"""Which triangles can't be seen for what stands before them: a hierarchy of depths (Greene, Kass and Miller 1993)."""

from __future__ import annotations

from functools import reduce

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, IntArray
from facepipe.pictures.rasterise import ScreenTriangles

Floats = npt.NDArray[np.float32]


def hidden(screen: ScreenTriangles, nearness: Floats, samples: int, top: int) -> BoolArray:
    """(s,) whether all pixels that a triangle may cover in a band of rows show something nearer.

    :param screen: triangles, in samples
    :param nearness: (rows, width) from which something shows in each pixel of the band
    :param samples: per pixel and direction
    :param top: the band's first row, pixels
    """
    rows, width = nearness.shape
    left, right = (_pixels(limit, samples, 0, width) for limit in (screen.x.min(axis=0), screen.x.max(axis=0)))
    first, last = (_pixels(limit, samples, top, rows) for limit in (screen.y[0], screen.y[2]))
    size = np.maximum(np.maximum(right - left, last - first), 1)
    # Cells of a level are 2 ** level pixels a side: no triangle reaches over more than three of its level, each way.
    level = np.maximum(np.ceil(np.log2(size)).astype(np.int64) - 1, 0)
    nearest = np.full(len(level), np.inf, np.float32)
    cells = nearness
    for number in range(int(level.max(initial=-1)) + 1):
        at = np.flatnonzero(level == number)
        for down, across in np.ndindex(3, 3):
            row = np.minimum((first[at] >> number) + down, last[at] >> number)
            column = np.minimum((left[at] >> number) + across, right[at] >> number)
            nearest[at] = np.minimum(nearest[at], cells[row, column])
        cells = _halved(cells)
    return np.asarray(screen.limits[1] <= nearest)


def _pixels(positions: npt.NDArray[np.floating], samples: int, start: int, count: int) -> IntArray:
    """Pixels from `start` on, of `count`, in which positions in samples are."""
    return np.asarray(np.clip(positions // samples - start, 0, count - 1), np.int64)


def _halved(cells: Floats) -> Floats:
    """The least of two by two cells, or fewer at the far borders."""
    even = np.pad(cells, [(0, side % 2) for side in cells.shape], mode="edge")
    return least(even, 2)


def least(values: Floats, side: int) -> Floats:
    """The least in each square of values (h * side, w * side): (h, w)."""
    pieces = [values[y::side, x::side] for y, x in np.ndindex(side, side)]
    return np.asarray(reduce(np.minimum, pieces))
