"""From a scene to pixels: what is solid, light scattered below it, and see-through layers over it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.rasterise import Raster, rasterise, screen_triangles
from facepipe.pictures.columns import chosen, joined
from facepipe.pictures.layers import Layers, layers
from facepipe.pictures.portrait import scatter_share
from facepipe.pictures.scatter import open_share, smoothed, spread
from facepipe.pictures.shade import Shaded, Shader

SAMPLES_PER_BAND = 1_000_000
_SMOOTH = 0.94  # cosine between triangles, below which a pixel that shows both shades each of them
_STEP = 8.0  # pixels of depth within one pixel, beyond which it shows two things
_HOLLOW = 5.0  # mm; width of the hollows that keep soft light away, too narrow for the maps of the sky
_SCATTERED = 2.5  # mm; standard deviation of where light leaves skin around where it went in


@dataclass(frozen=True, kw_only=True)
class Spots:
    """Where solid things are shaded: once in a plain pixel, once for every triangle where there are edges."""

    pixel: IntArray  # (m,) ascending
    triangle: IntArray  # (m,)
    x: FloatArray  # (m,) pixels
    y: FloatArray  # (m,)
    share: FloatArray  # (m,) of the pixel


def draw(shader: Shader, size: int, background: Float32Array, samples: int, mm: float) -> ByteArray:
    """(size, size, 3) sRGB pixels of the scene.

    :param background: (size, size, 3) linear, which is drawn on
    :param samples: per pixel and direction, of what covers a pixel; light is computed once or a few times in each
    :param mm: millimetres of a unit of the scene
    """
    spots, over = seen(shader, size, samples)
    shader.prepare(spots.triangle if over is None else np.append(spots.triangle, over.triangle))
    picture = background.reshape(-1, 3)
    _paint(picture, shader, spots, size, mm)
    if over is not None:
        over.blend(picture, shader)
    encoded = to_srgb(picture.reshape(size, size, 3)) * 255 + 0.5
    return encoded.astype(np.uint8)


def seen(shader: Shader, size: int, samples: int) -> tuple[Spots, Layers | None]:
    """What of the scene shows in a picture, found band by band: samples take more memory than what is made of them.

    Arguments are as for `draw`.
    """
    fine = shader.homogeneous * (samples, samples, 1.0, 1.0)
    screen = screen_triangles(fine, shader.scene.triangles)
    solid, clear = screen.select(~shader.scene.see_through), screen.select(shader.scene.see_through)
    clear = clear.take(np.argsort(-clear.limits[1], kind="stable"))  # from front to back
    rows = max(1, SAMPLES_PER_BAND // (size * samples * samples))

    def band(top: int) -> tuple[Spots, Layers | None]:
        fine = top * samples, min(top + rows, size) * samples
        raster = rasterise(solid, size * samples, size * samples, rows=fine)
        spots, over = _spots(shader, raster, samples, top), layers(shader, clear, raster, samples, fine)
        return spots if over is None else chosen(spots, np.flatnonzero(~over.hidden(size * size)[spots.pixel])), over

    spots, over = zip(*mapped(band, range(0, size, rows)), strict=True)
    veils = [one for one in over if one is not None]
    return joined(spots), joined(veils) if veils else None


def _spots(shader: Shader, raster: Raster, samples: int, top: int) -> Spots:
    """The spots of a band of rows from `top` down."""
    width = raster.key.shape[1] // samples
    grid = raster.triangle.astype(np.int32).reshape(-1, samples, width, samples)
    middle = samples // 2
    center = grid[:, middle, :, middle]
    even = np.ones(center.shape, bool)
    for y, x in np.ndindex(samples, samples):
        even &= grid[:, y, :, x] == center
    mixed = np.flatnonzero(~even)
    inner = grid.transpose(0, 2, 1, 3).reshape(-1, samples * samples)[mixed]
    near = raster.nearness.reshape(grid.shape).transpose(0, 2, 1, 3).reshape(-1, samples * samples)[mixed]
    plain = _plain(shader, inner, near, center.ravel()[mixed])
    even.ravel()[mixed[plain]] = True
    once = np.flatnonzero(even & (center >= 0))
    edges = _edges(inner[~plain], mixed[~plain], width, samples)
    pixel = np.concatenate([once, edges.pixel])
    order = np.argsort(pixel, kind="stable")
    row, column = np.divmod(once, width)
    return Spots(
        pixel=pixel[order] + top * width,
        triangle=np.concatenate([center.ravel()[once], edges.triangle])[order],
        x=np.concatenate([column + 0.5, edges.x])[order],
        y=np.concatenate([row + 0.5, edges.y])[order] + top,
        share=np.concatenate([np.ones(len(once)), edges.share])[order],
    )


def _plain(shader: Shader, triangles: IntArray, nearness: Float32Array, center: IntArray) -> BoolArray:
    """(p,) pixels with triangles (p, s) that are one smooth surface, which can be shaded at once."""
    covered = (triangles >= 0).all(axis=1)
    surface = shader.scene.surface
    plain = covered & (surface[triangles] == surface[center][:, None]).all(axis=1)
    at = np.flatnonzero(plain)
    facets = shader.unit_facets
    level = np.full(len(at), 1.0, np.float32)
    for sample in range(triangles.shape[1]):
        cosine = np.einsum("pc,pc->p", facets[triangles[at, sample]], facets[center[at]])
        level = np.minimum(level, cosine)
    depth = 1.0 / np.maximum(nearness[at], 1e-12)
    step = np.ptp(depth, axis=1) * shader.camera.focal / depth.min(axis=1) if len(at) else level
    plain[at] = (level > _SMOOTH) & (step < _STEP)
    return np.asarray(plain)


def _edges(triangles: IntArray, pixel: IntArray, width: int, samples: int) -> Spots:
    """A spot for each triangle of pixels that show (p, s) several: in the middle of the samples that it covers."""
    which, sample = np.nonzero(triangles >= 0)
    shown = triangles[which, sample].astype(np.int64)
    several = int(shown.max(initial=0)) + 1
    code, spot, count = np.unique(which * several + shown, return_inverse=True, return_counts=True)
    which, shown = np.divmod(code, several)
    down, right = np.divmod(sample, samples)
    row, column = np.divmod(pixel[which], width)
    x, y = (np.bincount(spot, (step + 0.5) / samples, len(code)) / np.maximum(count, 1) for step in (right, down))
    return Spots(pixel=pixel[which], triangle=shown, x=column + x, y=row + y, share=count / samples**2)


def _paint(picture: Float32Array, shader: Shader, spots: Spots, size: int, mm: float) -> None:
    """Put what is solid over the background (size * size, 3)."""
    if not len(spots.pixel):
        return
    shaded = shader.shade(spots.triangle, spots.x, spots.y, grainy=shader.studio.soft)
    if shader.studio.soft:
        shaded = _softened(shaded, spots, _window(spots.pixel, size), shader.camera.focal, mm)
    color = shaded.toned(shader.studio.tone) * spots.share[:, None]
    picture *= 1 - np.bincount(spots.pixel, spots.share, len(picture))[:, None]
    for channel in range(3):
        picture[:, channel] += np.bincount(spots.pixel, color[:, channel], len(picture))


@dataclass(frozen=True, kw_only=True)
class _Window:
    """The rectangle of the picture where things are."""

    shape: tuple[int, int]
    place: IntArray  # (m,) of the spots, row by row

    def image(self, values: FloatArray) -> Float32Array:
        """Sums of the spots' values (m,) in pixels."""
        return np.bincount(self.place, values, int(np.prod(self.shape))).reshape(self.shape).astype(np.float32)

    def read(self, image: Float32Array) -> Float32Array:
        """(m, ...) the spots' values of an image."""
        return image.reshape(-1, *image.shape[2:])[self.place]


def _window(pixel: IntArray, size: int) -> _Window:
    row, column = np.divmod(pixel, size)
    top, left = row.min(), column.min()
    shape = int(row.max() - top) + 1, int(column.max() - left) + 1
    return _Window(shape=shape, place=(row - top) * shape[1] + column - left)


def _softened(shaded: Shaded, spots: Spots, window: _Window, focal: float, mm: float) -> Shaded:
    """Samples with shadows free of grain, and with the light that comes to them below the surface."""
    share, depth = window.image(spots.share), window.image(spots.share * shaded.depth)
    open_to = window.read(open_share(depth, share, _HOLLOW / mm, focal))
    apart = np.abs(shaded.depth * window.read(share) - window.read(depth)) > _STEP / focal * shaded.depth
    open_to[apart] = 1.0  # edges before something farther away are no hollows
    hidden = window.read(smoothed(window.image(spots.share * shaded.key_light), share, depth, focal))
    shaded = replace(shaded, key_light=hidden * np.sqrt(open_to), lit=shaded.lit.dimmed(open_to))
    light = np.stack([window.image(spots.share * channel) for channel in shaded.diffuse.T], axis=-1)
    change = window.read(spread(light, share, depth, _SCATTERED / mm, focal))
    return replace(shaded, scattered=scatter_share(shaded.base) * change)
