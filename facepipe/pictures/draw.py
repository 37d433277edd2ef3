"""From a scene to pixels: bands of super-samples, opaque first, then a few see-through layers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.pictures.rasterise import Raster, ScreenTriangles, rasterise, screen_triangles
from facepipe.pictures.shade import Shader
from facepipe.pictures.textures import linear_to_srgb

Image8 = npt.NDArray[np.uint8]

SAMPLES_PER_BAND = 1_500_000
LAYERS = 3  # see-through layers that are told apart; what lies behind the third is left out


def draw(shader: Shader, size: int, backdrop: Callable[[int, int], FloatArray], samples: int) -> Image8:
    """(size, size, 3) sRGB pixels of the scene.

    :param shader: its camera counts super-samples: `samples` times the pixels of the picture
    :param backdrop: gives the linear background (rows, size, 3) of a half-open range of rows
    :param samples: per pixel and direction
    """
    screen = screen_triangles(shader.homogeneous, shader.scene.triangles)
    opaque, clear = screen.select(~shader.scene.see_through), screen.select(shader.scene.see_through)
    picture = np.empty((size, size, 3), np.uint8)
    rows = max(1, SAMPLES_PER_BAND // (size * samples * samples))
    for top in range(0, size, rows):
        bottom = min(top + rows, size)
        fine = backdrop(top, bottom).astype(np.float32).repeat(samples, axis=0).repeat(samples, axis=1)
        _draw_band(shader, opaque, clear, fine, (size * samples, size * samples), (top * samples, bottom * samples))
        linear = fine.reshape(-1, samples, size, samples, 3).mean(axis=(1, 3))
        picture[top:bottom] = (linear_to_srgb(linear) * 255 + 0.5).astype(np.uint8)
    return picture


def _draw_band(
    shader: Shader,
    opaque: ScreenTriangles,
    clear: ScreenTriangles,
    fine: FloatArray,
    size: tuple[int, int],
    rows: tuple[int, int],
) -> None:
    solid = rasterise(opaque, *size, rows=rows)
    _blend(shader, solid, solid.key > 0, fine)
    layers: list[Raster] = []
    for _ in range(LAYERS if len(clear.ids) else 0):
        ceiling = layers[-1].key if layers else None
        layers.append(rasterise(clear, *size, rows=rows, floor=solid.key, ceiling=ceiling))
    for layer in reversed(layers):
        _blend(shader, layer, layer.key > solid.key, fine)


def _blend(shader: Shader, raster: Raster, covered: npt.NDArray[np.bool_], fine: FloatArray) -> None:
    row, column = np.nonzero(covered)
    if not len(row):
        return
    color, opacity = shader.shade(raster.triangle[row, column], column + 0.5, row + raster.first_row + 0.5)
    fine[row, column] = np.minimum(fine[row, column] * (1 - opacity[:, None]) + color, 1.0)
