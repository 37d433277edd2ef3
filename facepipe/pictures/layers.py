"""See-through surfaces over what is solid: every fragment of every pixel, from front to back.

A fragment is a triangle in a pixel. The samples of the pixel say how much of it the triangle covers and what of that
lies before everything solid; its opacity and its light are computed once. Fragments of one surface that meet in a pixel
cover it side by side, so that the edges inside a card don't show; other fragments lie over each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import IntArray
from facepipe.pictures.columns import chosen, joined
from facepipe.pictures.rasterise import Raster, ScreenTriangles, Spans, expand, spans_of
from facepipe.pictures.shade import Shader

Floats = npt.NDArray[np.float32]

_FAINT = 1 / 250  # of a pixel's light: fainter fragments are not drawn
_TOGETHER = 2.0  # pixels in depth between fragments that may belong to one sheet


@dataclass(frozen=True, kw_only=True)
class Layers:
    """Fragments of see-through triangles, and how much of what is solid comes past them."""

    pixel: IntArray  # (f,) ascending, from front to back in each
    triangle: IntArray  # (f,)
    x: Floats  # (f,) pixels, in the middle of what is covered
    y: Floats  # (f,)
    weight: Floats  # (f,) share of the pixel that it covers and whose light comes past the layers before it
    veiled: IntArray  # (v,) pixels with layers
    passed: Floats  # (v,) share of the light from behind all layers

    def blend(self, picture: Floats, shader: Shader) -> None:
        """Put the layers over a linear picture (pixels, 3)."""
        picture[self.veiled] *= self.passed[:, None]
        shaded = shader.shade(self.triangle, self.x, self.y)
        color = shaded.toned(shader.studio.tone) * self.weight[:, None]
        for channel in range(3):
            picture[:, channel] += np.bincount(self.pixel, color[:, channel], minlength=len(picture))
        np.minimum(picture, 1.0, out=picture)


@dataclass(frozen=True, kw_only=True)
class _Fragments:
    pixel: IntArray  # (f,) in the band
    triangle: IntArray  # (f,)
    nearness: Floats  # (f,)
    share: Floats  # (f,) of the pixel's samples that it covers before everything solid
    x: Floats  # (f,) pixels
    y: Floats  # (f,)


def layers(
    shader: Shader, screen: ScreenTriangles, solid: Raster, samples: int, rows: tuple[int, int]
) -> Layers | None:
    """The layers of a band; None where there are none.

    :param screen: see-through triangles, in samples
    :param solid: what is solid in the band
    :param rows: half-open range of its rows, in samples
    """
    width = solid.key.shape[1]
    nearest = solid.nearness
    found = [_fragments(screen, spans, nearest, samples, rows[0]) for spans in spans_of(screen, width, *rows)]
    if not found:
        return None
    every = joined(found)
    opacity = shader.opacity(every.triangle, every.x, every.y)
    there = np.flatnonzero(opacity > _FAINT)
    return _stacked(shader, chosen(every, there), opacity[there], rows[0] // samples * (width // samples))


def _fragments(screen: ScreenTriangles, spans: Spans, nearest: Floats, samples: int, top: int) -> _Fragments:
    """What the triangles of some spans cover."""
    width = nearest.shape[1] // samples
    starts, stops, first = _by_pixel_row(spans, samples)
    group, step = expand(-(-stops.max(axis=1) // samples) - starts.min(axis=1) // samples)
    owner, row = spans.owner[first][group], spans.row[first][group] // samples
    column = (starts.min(axis=1) // samples)[group] + step
    slope, down = (each[owner].astype(np.float32) for each in screen.gradient)
    corner = (column * samples + 0.5 - screen.x[0, owner]) * slope + (row * samples + 0.5 - screen.y[0, owner]) * down
    corner = (screen.nearness[owner] + corner).astype(np.float32)
    low, high = (each[owner].astype(np.float32) for each in screen.limits)
    covered, right, below, total = (np.zeros(len(owner), np.float32) for _ in range(4))
    for y in range(samples):
        start, stop = starts[group, y], stops[group, y]
        for x in range(samples):
            at = column * samples + x
            nearness = np.clip(corner + (x * slope + y * down), low, high)
            seen = (start <= at) & (at < stop)
            seen &= nearest[row * samples + y - top, at] < nearness
            covered += seen
            right += seen * np.float32(x)
            below += seen * np.float32(y)
            total += seen * nearness
    at = np.flatnonzero(covered)
    covered = covered[at]
    return _Fragments(
        pixel=(row[at] - top // samples) * width + column[at],
        triangle=screen.ids[owner[at]],
        nearness=total[at] / covered,
        share=covered / np.float32(samples**2),
        x=(column[at] + (right[at] / covered + 0.5) / samples).astype(np.float32),
        y=(row[at] + (below[at] / covered + 0.5) / samples).astype(np.float32),
    )


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


def _stacked(shader: Shader, found: _Fragments, opacity: Floats, first: int) -> Layers:
    """Fragments in order, with what comes past those before them.

    :param first: number of the band's first pixel
    """
    far = np.uint64(0xFFFFFFFF) - found.nearness.view(np.uint32).astype(np.uint64)
    order = np.argsort((found.pixel.astype(np.uint64) << np.uint64(32)) | far, kind="stable")
    found, opacity = chosen(found, order), opacity[order]
    sheet = _sheets(shader, found)
    filled = np.maximum(np.bincount(sheet, found.share), 1.0)
    solid = np.bincount(sheet, found.share * opacity) / filled
    clear = np.log(1 - np.minimum(solid, 0.9999))
    before = np.cumsum(clear) - clear
    pixel = found.pixel[np.flatnonzero(np.diff(sheet, prepend=-1))]  # of each sheet
    veiled, start = np.unique(pixel, return_index=True)
    passing = np.exp(before - np.repeat(before[start], np.diff(np.append(start, len(pixel)))))
    weight = (found.share * (passing / filled)[sheet]).astype(np.float32)
    at = np.flatnonzero(weight * opacity > _FAINT)
    return Layers(
        pixel=found.pixel[at] + first,
        triangle=found.triangle[at],
        x=found.x[at],
        y=found.y[at],
        weight=weight[at],
        veiled=veiled + first,
        passed=np.exp(np.add.reduceat(clear, start)).astype(np.float32) if len(start) else np.zeros(0, np.float32),
    )


def _sheets(shader: Shader, found: _Fragments) -> IntArray:
    """(f,) numbers of the sheets that fragments belong to, in the order of the fragments.

    A sheet lies side by side in a pixel: neighbours in depth of one surface, as long as they fill the pixel once.
    """
    surface = shader.scene.surface[found.triangle]
    apart = np.ones(len(surface), bool)
    near = found.nearness
    apart[1:] = found.pixel[1:] != found.pixel[:-1]
    apart[1:] |= surface[1:] != surface[:-1]
    apart[1:] |= near[:-1] - near[1:] > _TOGETHER / shader.camera.focal * near[:-1]
    start = np.flatnonzero(apart)
    middle = np.cumsum(found.share, dtype=np.float64) - found.share / 2
    filled = np.floor(middle - (middle - found.share / 2)[start][np.cumsum(apart) - 1])
    apart[1:] |= filled[1:] > filled[:-1]
    return np.cumsum(apart) - 1
