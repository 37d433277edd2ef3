"""What see-through triangles cover of pixels: fragments, a triangle in a pixel each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import IntArray
from facepipe.pictures.rasterise import ScreenTriangles, Spans, expand

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Fragments:
    """Where triangles show in pixels, f of them."""

    pixel: IntArray  # (f,) in the band
    triangle: IntArray  # (f,)
    nearness: Floats  # (f,)
    share: Floats  # (f,) of the pixel's samples that it covers before everything solid
    x: Floats  # (f,) pixels
    y: Floats  # (f,)


def fragments(
    screen: ScreenTriangles, spans: Spans, nearest: Floats, behind: Floats, samples: int, top: int
) -> Fragments:
    """What the triangles of some spans cover.

    :param nearest: (rows * samples, width * samples) nearness of what is solid, in the samples of a band
    :param behind: (rows, width) nearness in its pixels from which something shows
    :param top: the band's first row, in samples
    """
    width = behind.shape[1]
    starts, stops, first = _by_pixel_row(spans, samples)
    owner, row, column = spans.owner[first], spans.row[first] // samples, starts.min(axis=1) // samples
    plane = _planes(screen, owner, row * samples, column * samples)
    group, step = expand(-(-stops.max(axis=1) // samples) - column)
    pixel = ((row - top // samples) * width + column)[group] + step
    beside = (step * samples).astype(np.float32)
    shown = np.flatnonzero(plane.most(group, beside, samples) > behind.reshape(-1)[pixel])
    group, pixel = group[shown], pixel[shown]
    row, column = row[group], column[group] + step[shown]
    nearness_at = plane.of(group, beside[shown])
    covered, right, below, total = (np.zeros(len(group), np.float32) for _ in range(4))
    for y in range(samples):
        start, stop = starts[group, y], stops[group, y]
        for x in range(samples):
            at = column * samples + x
            nearness = nearness_at(x, y)
            seen = (start <= at) & (at < stop)
            seen &= nearest[row * samples + y - top, at] < nearness
            covered += seen
            right += seen * np.float32(x)
            below += seen * np.float32(y)
            total += seen * nearness
    at = np.flatnonzero(covered)
    covered = covered[at]
    return Fragments(
        pixel=pixel[at],
        triangle=screen.ids[owner[group[at]]],
        nearness=total[at] / covered,
        share=covered / np.float32(samples**2),
        x=(column[at] + (right[at] / covered + 0.5) / samples).astype(np.float32),
        y=(row[at] + (below[at] / covered + 0.5) / samples).astype(np.float32),
    )


@dataclass(frozen=True, kw_only=True)
class _Planes:
    """Nearness of triangles in rows of pixels, g of them, in samples from the first one of each row."""

    start: Floats  # (g,)
    slope: Floats  # (g,) to the right
    down: Floats  # (g,)
    low: Floats  # (g,) least and most anywhere in the triangle
    high: Floats  # (g,)

    def of(self, group: IntArray, right: Floats) -> Callable[[int, int], Floats]:
        """(k,) nearness x and y samples beside and below those that are (k,) samples to the right in rows `group`."""
        slope, down, low, high = (each[group] for each in (self.slope, self.down, self.low, self.high))
        start = self.start[group] + right * slope
        return lambda x, y: np.clip(start + (x * slope + y * down), low, high)

    def most(self, group: IntArray, right: Floats, samples: int) -> Floats:
        """(k,) bound of the nearness in pixels that start (k,) samples to the right in rows `group`."""
        corner = self.start + (np.maximum(self.slope, 0) + np.maximum(self.down, 0)) * (samples - 1)
        return np.asarray(np.minimum(corner[group] + right * self.slope[group], self.high[group]))


def _planes(screen: ScreenTriangles, owner: IntArray, row: IntArray, column: IntArray) -> _Planes:
    """The planes of triangles from the samples in `row` and `column` on, each (g,)."""
    slope, down = (each[owner] for each in screen.gradient)
    start = screen.nearness[owner]
    start = start + (column + 0.5 - screen.x[0, owner]) * slope + (row + 0.5 - screen.y[0, owner]) * down
    values = (start, slope, down, *screen.limits[:, owner])
    start, slope, down, low, high = (each.astype(np.float32) for each in values)
    return _Planes(start=start, slope=slope, down=down, low=low, high=high)


def _by_pixel_row(spans: Spans, samples: int) -> tuple[IntArray, IntArray, IntArray]:
    """Starts and stops (g, samples) of the spans of a triangle in a row of pixels, and the first span (g,) of each."""
    owner, row = spans.owner, spans.row
    new = np.ones(len(owner), bool)
    new[1:] = (owner[1:] != owner[:-1]) | (row[1:] // samples != row[:-1] // samples)
    group = np.cumsum(new) - 1
    starts = np.full((int(new.sum()), samples), np.iinfo(np.int64).max)
    stops = np.zeros_like(starts)
    starts[group, row % samples] = spans.start
    stops[group, row % samples] = spans.start + spans.count
    return starts, stops, np.flatnonzero(new)
