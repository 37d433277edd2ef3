"""See-through surfaces over what is solid: every fragment of every pixel, from front to back.

A fragment is a triangle in a pixel. The samples of the pixel say how much of it the triangle covers and what of that
lies before everything solid; its opacity and its light are computed once. Fragments of one surface that meet in a pixel
cover it side by side, so that the edges inside a card don't show; other fragments lie over each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, IntArray
from facepipe.pictures.columns import chosen, joined
from facepipe.pictures.fragments import Fragments, fragments
from facepipe.pictures.hidden import hidden, least
from facepipe.pictures.rasterise import Raster, ScreenTriangles, spans_of
from facepipe.pictures.shade import Shader

Floats = npt.NDArray[np.float32]

_FAINT = 1 / 250  # of a pixel's light: fainter fragments are not drawn
_TOGETHER = 2.0  # pixels in depth between fragments that may belong to one sheet
_AT_ONCE = 400  # triangles; what they hide of those after them is left out


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

    def hidden(self, count: int) -> BoolArray:
        """(count,) whether the layers let no light of what is solid past, for all pixels of the picture."""
        found = np.zeros(count, bool)
        found[self.veiled] = self.passed < _FAINT
        return found

    def blend(self, picture: Floats, shader: Shader) -> None:
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
    found: list[tuple[Fragments, Floats]] = []
    for start in range(0, len(inside), _AT_ONCE):
        part = screen.take(inside[start : start + _AT_ONCE])
        part = part.take(np.flatnonzero(~hidden(part, behind, samples, top)))
        for spans in spans_of(part, width * samples, *rows):
            every = fragments(part, spans, nearest, behind, samples, rows[0])
            opacity = shader.opacity(every.triangle, every.x, every.y)
            there = np.flatnonzero(opacity > _FAINT)
            found.append((chosen(every, there), opacity[there]))
            _hide(behind, *found[-1])
    if not found:
        return None
    several, opacities = zip(*found, strict=True)
    return _stacked(shader, joined(several), np.concatenate(opacities), top * width)


def _hide(behind: Floats, found: Fragments, opacity: Floats) -> None:
    """Note in `behind` (rows, width) the nearness of fragments that let no light past them."""
    at = np.flatnonzero((found.share == 1) & (opacity > 1 - _FAINT))
    np.maximum.at(behind.reshape(-1), found.pixel[at], found.nearness[at])


def _stacked(shader: Shader, found: Fragments, opacity: Floats, first: int) -> Layers:
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


def _sheets(shader: Shader, found: Fragments) -> IntArray:
    """(f,) numbers of the sheets that fragments belong to, in the order of the fragments.

    A sheet lies side by side in a pixel: neighbours in depth of one surface, as long as they fill the pixel once. What
    fills it alone is a sheet alone.
    """
    surface = shader.scene.surface[found.triangle]
    apart = np.ones(len(surface), bool)
    near = found.nearness
    apart[1:] = found.pixel[1:] != found.pixel[:-1]
    apart[1:] |= surface[1:] != surface[:-1]
    apart[1:] |= near[:-1] - near[1:] > _TOGETHER / shader.camera.focal * near[:-1]
    alone = found.share == 1
    apart[1:] |= alone[1:] | alone[:-1]
    start = np.flatnonzero(apart)
    middle = np.cumsum(found.share, dtype=np.float64) - found.share / 2
    filled = np.floor(middle - (middle - found.share / 2)[start][np.cumsum(apart) - 1])
    apart[1:] |= filled[1:] > filled[:-1]
    return np.cumsum(apart) - 1
