"""See-through surfaces over what is solid: every fragment of every pixel, from front to back.

A fragment is a triangle in a pixel. The samples of the pixel say how much of it the triangle covers and what of that
lies before everything solid; its opacity and its light are computed once. Fragments of one surface that meet in a pixel
cover it side by side, so that the edges inside a card don't show; other fragments lie over each other.

Triangles that stand wholly behind what is solid are left out by a hierarchy of depths (Greene, Kass and Miller 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.geometry.rasterise import Raster, ScreenTriangles, Spans, expand, spans_of
from facepipe.pictures.columns import chosen, joined
from facepipe.pictures.shade import Shader

_FAINT = 1 / 250  # of a pixel's light: fainter fragments are not drawn
_TOGETHER = 2.0  # pixels in depth between fragments that may belong to one sheet
_AT_ONCE = 400  # triangles; what they hide of those after them is left out


def hidden(screen: ScreenTriangles, nearness: Float32Array, samples: int, top: int) -> BoolArray:
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


def _pixels(positions: FloatArray, samples: int, start: int, count: int) -> IntArray:
    """Pixels from `start` on, of `count`, in which positions in samples are."""
    return np.asarray(np.clip(positions // samples - start, 0, count - 1), np.int64)


def _halved(cells: Float32Array) -> Float32Array:
    """The least of two by two cells, or fewer at the far borders."""
    even = np.pad(cells, [(0, side % 2) for side in cells.shape], mode="edge")
    return least(even, 2)


def least(values: Float32Array, side: int) -> Float32Array:
    """The least in each square of values (h * side, w * side): (h, w)."""
    pieces = [values[y::side, x::side] for y, x in np.ndindex(side, side)]
    return np.asarray(reduce(np.minimum, pieces))


@dataclass(frozen=True, kw_only=True)
class Fragments:
    """Where triangles show in pixels, f of them."""

    pixel: IntArray  # (f,) in the band
    triangle: IntArray  # (f,)
    nearness: Float32Array  # (f,)
    share: Float32Array  # (f,) of the pixel's samples that it covers before everything solid
    x: Float32Array  # (f,) pixels
    y: Float32Array  # (f,)


def fragments(
    screen: ScreenTriangles, spans: Spans, nearest: Float32Array, behind: Float32Array, samples: int, top: int
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
    nearness_at = plane.nearness(group, beside[shown])
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

    start: Float32Array  # (g,)
    slope: Float32Array  # (g,) to the right
    down: Float32Array  # (g,)
    low: Float32Array  # (g,) least and most anywhere in the triangle
    high: Float32Array  # (g,)

    def nearness(self, group: IntArray, right: Float32Array) -> Callable[[int, int], Float32Array]:
        """(k,) nearness x and y samples beside and below those that are (k,) samples to the right in rows `group`."""
        slope, down, low, high = (each[group] for each in (self.slope, self.down, self.low, self.high))
        start = self.start[group] + right * slope
        return lambda x, y: np.clip(start + (x * slope + y * down), low, high)

    def most(self, group: IntArray, right: Float32Array, samples: int) -> Float32Array:
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


@dataclass(frozen=True, kw_only=True)
class Layers:
    """Fragments of see-through triangles, and how much of what is solid comes past them."""

    pixel: IntArray  # (f,) ascending, from front to back in each
    triangle: IntArray  # (f,)
    x: Float32Array  # (f,) pixels, in the middle of what is covered
    y: Float32Array  # (f,)
    weight: Float32Array  # (f,) share of the pixel that it covers and whose light comes past the layers before it
    veiled: IntArray  # (v,) pixels with layers
    passed: Float32Array  # (v,) share of the light from behind all layers

    def hidden(self, count: int) -> BoolArray:
        """(count,) whether the layers let no light of what is solid past, for all pixels of the picture."""
        found = np.zeros(count, bool)
        found[self.veiled] = self.passed < _FAINT
        return found

    def blend(self, picture: Float32Array, shader: Shader) -> None:
        """Put the layers over a linear picture (pixels, 3)."""
        picture[self.veiled] *= self.passed[:, None]
        shaded = shader.shade(self.triangle, self.x, self.y)
        color = shaded.toned(shader.studio.tone) * self.weight[:, None]
        for channel in range(3):
            picture[:, channel] += np.bincount(self.pixel, color[:, channel], minlength=len(picture))
        np.minimum(picture, 1.0, out=picture)


def layers(
    shader: Shader, screen: ScreenTriangles, solid: Raster, samples: int, rows: tuple[int, int]
) -> Layers | None:
    """The layers of a band; None where there are none.

    :param screen: see-through triangles, in samples; quickest with the nearest first
    :param solid: what is solid in the band
    :param rows: half-open range of its rows, in samples
    """
    inside = np.flatnonzero((screen.y[2] > rows[0]) & (screen.y[0] < rows[1]))
    nearest, top, width = solid.nearness, rows[0] // samples, solid.key.shape[1] // samples
    behind = least(nearest, samples) if len(inside) else nearest
    parts: list[tuple[Fragments, Float32Array]] = []
    for start in range(0, len(inside), _AT_ONCE):
        part = screen.take(inside[start : start + _AT_ONCE])
        part = part.take(np.flatnonzero(~hidden(part, behind, samples, top)))
        for spans in spans_of(part, width * samples, *rows):
            every = fragments(part, spans, nearest, behind, samples, rows[0])
            opacity = shader.opacity(every.triangle, every.x, every.y)
            there = np.flatnonzero(opacity > _FAINT)
            parts.append((chosen(every, there), opacity[there]))
            _hide(behind, *parts[-1])
    if not parts:
        return None
    several, opacities = zip(*parts, strict=True)
    return _stacked(shader, joined(several), np.concatenate(opacities), top * width)


def _hide(behind: Float32Array, fragments: Fragments, opacity: Float32Array) -> None:
    """Note in `behind` (rows, width) the nearness of fragments that let no light past them."""
    at = np.flatnonzero((fragments.share == 1) & (opacity > 1 - _FAINT))
    np.maximum.at(behind.reshape(-1), fragments.pixel[at], fragments.nearness[at])


def _stacked(shader: Shader, fragments: Fragments, opacity: Float32Array, first: int) -> Layers:
    """Fragments in order, with what comes past those before them.

    :param first: number of the band's first pixel
    """
    far = np.uint64(0xFFFFFFFF) - fragments.nearness.view(np.uint32).astype(np.uint64)
    order = np.argsort((fragments.pixel.astype(np.uint64) << np.uint64(32)) | far, kind="stable")
    fragments, opacity = chosen(fragments, order), opacity[order]
    sheet = _sheets(shader, fragments)
    filled = np.maximum(np.bincount(sheet, fragments.share), 1.0)
    solid = np.bincount(sheet, fragments.share * opacity) / filled
    clear = np.log(1 - np.minimum(solid, 0.9999))
    before = np.cumsum(clear) - clear
    pixel = fragments.pixel[np.flatnonzero(np.diff(sheet, prepend=-1))]  # of each sheet
    veiled, start = np.unique(pixel, return_index=True)
    passing = np.exp(before - np.repeat(before[start], np.diff(np.append(start, len(pixel)))))
    weight = (fragments.share * (passing / filled)[sheet]).astype(np.float32)
    at = np.flatnonzero(weight * opacity > _FAINT)
    return Layers(
        pixel=fragments.pixel[at] + first,
        triangle=fragments.triangle[at],
        x=fragments.x[at],
        y=fragments.y[at],
        weight=weight[at],
        veiled=veiled + first,
        passed=np.exp(np.add.reduceat(clear, start)).astype(np.float32) if len(start) else np.zeros(0, np.float32),
    )


def _sheets(shader: Shader, fragments: Fragments) -> IntArray:
    """(f,) numbers of the sheets that fragments belong to, in the order of the fragments.

    A sheet lies side by side in a pixel: neighbours in depth of one surface, as long as they fill the pixel once. What
    fills it alone is a sheet alone.
    """
    surface = shader.scene.surface[fragments.triangle]
    apart = np.ones(len(surface), bool)
    near = fragments.nearness
    apart[1:] = fragments.pixel[1:] != fragments.pixel[:-1]
    apart[1:] |= surface[1:] != surface[:-1]
    apart[1:] |= near[:-1] - near[1:] > _TOGETHER / shader.camera.focal * near[:-1]
    alone = fragments.share == 1
    apart[1:] |= alone[1:] | alone[:-1]
    start = np.flatnonzero(apart)
    middle = np.cumsum(fragments.share, dtype=np.float64) - fragments.share / 2
    filled = np.floor(middle - (middle - fragments.share / 2)[start][np.cumsum(apart) - 1])
    apart[1:] |= filled[1:] > filled[:-1]
    return np.cumsum(apart) - 1
