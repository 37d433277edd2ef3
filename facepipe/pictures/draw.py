"""From a scene to pixels: what is solid, light scattered below it, and see-through layers over it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from facepipe.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from facepipe.core.threads import mapped
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.rasterise import Raster, ScreenTriangles, Spans, expand, rasterise, screen_triangles, spans_of
from facepipe.pictures.lighting import scatter_share
from facepipe.pictures.shade import Shaded, Shader, chosen, joined

_RINGS = (0.35, 1.0)  # of the width of hollows
_COMPASS = ((0.0, 1.0), (0.7, 0.7), (1.0, 0.0), (0.7, -0.7))
_HOLLOW = 0.95  # of the light; how dark the deepest hollow is
_CELLS = 2.0  # in a standard deviation of the blur: finer detail of its result has no meaning
_FAINT = 1 / 250  # of a pixel's light: fainter fragments are not drawn
_TOGETHER = 2.0  # pixels in depth between fragments that may belong to one sheet
_AT_ONCE = 800  # triangles; what they hide of those after them is left out: with 400 a picture takes a tenth longer
SAMPLES_PER_BAND = 1_000_000
_SMOOTH = 0.94  # cosine between triangles, below which a pixel that shows both shades each of them
_STEP = 8.0  # pixels of depth within one pixel, beyond which it shows two things
_HOLLOW_MM = 5.0  # mm; width of the hollows that keep soft light away, too narrow for the maps of the sky
_SCATTERED = 2.5  # mm; standard deviation of where light leaves skin around where it went in


def spread(light: Float32Array, share: Float32Array, depth: Float32Array, width: float, focal: float) -> Float32Array:
    """(h, w, 3) what scattering adds to diffuse light (h, w, 3); negative where it takes some away.

    Light and depth (h, w) along the view are premultiplied by the share (h, w) of each pixel that surfaces cover. The
    standard deviation of the blur, `width`, is in units of depth, the focal length in pixels.
    """
    covered = float(share.sum())
    pixels = width * focal * covered / max(float(depth.sum()), 1e-12)
    if covered == 0 or pixels < 0.5:
        return np.zeros_like(light)
    cell = max(1, round(pixels / _CELLS))
    # (5, rows, columns) sums over square cells; those at the far borders may be smaller
    rows, columns = (-(-side // cell) for side in share.shape)
    padded = np.zeros((5, rows * cell, columns * cell), np.float32)
    padded[:, : share.shape[0], : share.shape[1]] = [*np.moveaxis(light, -1, 0), share, depth]
    coarse = np.asarray(padded.reshape(5, rows, cell, columns, cell).sum(axis=(2, 4)))
    values, far = coarse[:4], _mean(coarse[4], coarse[3])
    steps = np.arange(np.ceil(2.5 * pixels / cell) + 1, dtype=np.float32)
    blurred = _blurred(values, far, np.exp(-((steps * cell / pixels) ** 2) / 2), width)
    change = blurred - _mean(coarse[:3], coarse[3])
    enlarged = np.where(coarse[3] > 0, change, 0).astype(np.float32)
    # cells as pixels (3, h, w), blended between the cells' middles
    for axis in (1, 2):
        at = np.arange(share.shape[axis - 1], dtype=np.float32) + 0.5
        at = np.clip(at / cell - 0.5, 0, enlarged.shape[axis] - 1)
        low = at.astype(np.int64)
        high = np.minimum(low + 1, enlarged.shape[axis] - 1)
        between = (at - low).reshape((1, -1, 1) if axis == 1 else (1, 1, -1)).astype(np.float32)
        enlarged = enlarged.take(low, axis=axis) * (1 - between) + enlarged.take(high, axis=axis) * between
    return np.ascontiguousarray(np.moveaxis(enlarged, 0, -1))


def _blurred(values: Float32Array, depth: Float32Array, weights: Float32Array, width: float) -> Float32Array:
    """(c - 1, h, w) of values (c, h, w), the last of which is their share: blurred along rows, then columns, where the
    depth is alike.

    :param weights: of neighbours 0, 1, 2 ... pixels away
    """
    for axis in (0, 1):
        total = values * weights[0]
        for step in range(1, len(weights)):
            lower, upper = (
                tuple(each if other == axis else slice(None) for other in (0, 1))
                for each in (slice(0, -step), slice(step, None))
            )
            apart = (depth[lower] - depth[upper]) / np.float32(width)
            alike = weights[step] * np.exp(-apart * apart)
            total[:, *lower] += values[:, *upper] * alike
            total[:, *upper] += values[:, *lower] * alike
        values = total
    return _mean(values[:-1], values[-1])


def _mean(values: Float32Array, share: Float32Array) -> Float32Array:
    return np.asarray(values / np.where(share > 0, share, 1))


def open_share(depth: Float32Array, share: Float32Array, width: float, focal: float) -> Float32Array:
    """(h, w) share of soft light that reaches places between nearer ones: eyes under lids, lips on each other.

    Pairs of opposite neighbours rise above a place only where it lies in a hollow, however the surface is inclined.

    :param depth: (h, w) along the view, premultiplied by `share`
    :param width: of the hollows, in units of depth
    """
    far = np.where(share > 0, _mean(depth, share), np.finfo(np.float32).max / 4)
    covered = float(share.sum())
    pixels = width * focal * covered / max(float(depth.sum()), 1e-12)
    hidden = np.zeros_like(far)
    for part in _RINGS:
        reach = np.float32(part * width)
        steps = {(round(part * pixels * y), round(part * pixels * x)) for y, x in _COMPASS} - {(0, 0)}
        for down, right in steps:
            heights = [np.clip(far - _moved(far, y, x), -reach, reach) for y, x in ((down, right), (-down, -right))]
            hidden += np.maximum(heights[0] + heights[1], 0) / (2 * reach * len(_COMPASS) * len(_RINGS))
    return np.asarray(1 - _HOLLOW * hidden, np.float32)


def _moved(values: Float32Array, down: int, right: int) -> Float32Array:
    """(h, w) of each pixel the value `down` and `right` of it, at the borders the nearest one."""
    rows = np.clip(np.arange(values.shape[0]) + down, 0, values.shape[0] - 1)
    columns = np.clip(np.arange(values.shape[1]) + right, 0, values.shape[1] - 1)
    return np.asarray(values[rows][:, columns])


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
        even = np.pad(cells, [(0, side % 2) for side in cells.shape], mode="edge")
        cells = least(even, 2)
    return np.asarray(screen.limits[1] <= nearest)


def _pixels(positions: FloatArray, samples: int, start: int, count: int) -> IntArray:
    """Pixels from `start` on, of `count`, in which positions in samples are."""
    return np.asarray(np.clip(positions // samples - start, 0, count - 1), np.int64)


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
    owners, rows = spans.owner, spans.row
    new = np.ones(len(owners), bool)
    new[1:] = (owners[1:] != owners[:-1]) | (rows[1:] // samples != rows[:-1] // samples)
    row_group = np.cumsum(new) - 1
    starts = np.full((int(new.sum()), samples), np.iinfo(np.int64).max)
    stops = np.zeros_like(starts)
    starts[row_group, rows % samples] = spans.start
    stops[row_group, rows % samples] = spans.start + spans.count
    first = np.flatnonzero(new)
    owner, row, column = spans.owner[first], spans.row[first] // samples, starts.min(axis=1) // samples
    # of each row of pixels the nearness of its triangle's plane in the first sample, its change to the right and down,
    # and the least and most anywhere in the triangle
    slope, down = screen.gradient.take(owner, axis=1)
    begin = screen.nearness.take(owner) + (column * samples + 0.5 - screen.x[0].take(owner)) * slope
    begin = begin + (row * samples + 0.5 - screen.y[0].take(owner)) * down
    planes = [each.astype(np.float32) for each in (begin, slope, down, *screen.limits.take(owner, axis=1))]
    begin, slope, down, _, high = planes
    group, step = expand(-(-stops.max(axis=1) // samples) - column)
    pixel = ((row - top // samples) * width + column).take(group) + step
    beside = (step * samples).astype(np.float32)
    corner = begin + (np.maximum(slope, 0) + np.maximum(down, 0)) * (samples - 1)
    most = np.minimum(corner.take(group) + beside * slope.take(group), high.take(group))
    shown = np.flatnonzero(most > behind.reshape(-1).take(pixel))
    group, pixel = group.take(shown), pixel.take(shown)
    row, column = row.take(group), column.take(group) + step.take(shown)
    begin, slope, down, low, high = (each.take(group) for each in planes)
    begin = begin + beside.take(shown) * slope
    covered, right, below, total = (np.zeros(len(group), np.float32) for _ in range(4))
    for y in range(samples):
        start, stop = starts[:, y].take(group), stops[:, y].take(group)
        line = (row * samples + y - top) * nearest.shape[1]
        for x in range(samples):
            at = column * samples + x
            nearness = np.minimum(np.maximum(begin + (x * slope + y * down), low), high)
            seen = (start <= at) & (at < stop)
            seen &= nearest.reshape(-1).take(line + at) < nearness
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
class Layers:
    """Fragments of see-through triangles, and how much of what is solid comes past them."""

    pixel: IntArray  # (f,) ascending, from front to back in each
    triangle: IntArray  # (f,)
    x: Float32Array  # (f,) pixels, in the middle of what is covered
    y: Float32Array  # (f,)
    opacity: Float32Array  # (f,)
    weight: Float32Array  # (f,) share of the pixel that it covers and whose light comes past the layers before it
    veiled: IntArray  # (v,) pixels with layers
    passed: Float32Array  # (v,) share of the light from behind all layers

    def hidden(self, count: int) -> BoolArray:
        """(count,) whether the layers let no light of what is solid past, for all pixels of the picture."""
        found = np.zeros(count, bool)
        found[self.veiled] = self.passed < _FAINT
        return found

    def blend(self, picture: Float32Array, shader: Shader, place: IntArray) -> None:
        """Put the layers over a linear picture (3, k), which has each pixel of the whole at a `place`."""
        picture[:, place.take(self.veiled)] *= self.passed
        shaded = shader.shade(self.triangle, self.x, self.y, opacity=self.opacity)
        own = place.take(self.pixel)
        for channel, color in zip(picture, shaded.toned(shader.studio.tone).T, strict=True):
            channel += np.bincount(own, color * self.weight, minlength=len(channel))
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
            shown, opacity = chosen(every, there), opacity[there]
            parts.append((shown, opacity))
            # fragments that let no light past them hide those of the triangles to come
            at = np.flatnonzero((shown.share == 1) & (opacity > 1 - _FAINT))
            np.maximum.at(behind.reshape(-1), shown.pixel[at], shown.nearness[at])
    if not parts:
        return None
    several, opacities = zip(*parts, strict=True)
    return _stacked(shader, joined(several), np.concatenate(opacities), top * width)


def _stacked(shader: Shader, fragments: Fragments, opacity: Float32Array, first: int) -> Layers:
    """Fragments in order, with what comes past those before them; `first` is the number of the band's first pixel."""
    far = np.uint64(0xFFFFFFFF) - fragments.nearness.view(np.uint32).astype(np.uint64)
    order = np.argsort((fragments.pixel.astype(np.uint64) << np.uint64(32)) | far, kind="stable")
    fragments, opacity = chosen(fragments, order), opacity[order]
    # A sheet lies side by side in a pixel: neighbours in depth of one surface, as long as they fill the pixel once.
    # What fills it alone is a sheet alone.
    surface = shader.scene.surface[fragments.triangle]
    apart = np.ones(len(surface), bool)
    near = fragments.nearness
    apart[1:] = fragments.pixel[1:] != fragments.pixel[:-1]
    apart[1:] |= surface[1:] != surface[:-1]
    apart[1:] |= near[:-1] - near[1:] > _TOGETHER / shader.camera.focal * near[:-1]
    alone = fragments.share == 1
    apart[1:] |= alone[1:] | alone[:-1]
    firsts = np.flatnonzero(apart)
    middle = np.cumsum(fragments.share, dtype=np.float64) - fragments.share / 2
    times_filled = np.floor(middle - (middle - fragments.share / 2)[firsts][np.cumsum(apart) - 1])
    apart[1:] |= times_filled[1:] > times_filled[:-1]
    sheet = np.cumsum(apart) - 1
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
        opacity=opacity[at],
        weight=weight[at],
        veiled=veiled + first,
        passed=np.exp(np.add.reduceat(clear, start)).astype(np.float32) if len(start) else np.zeros(0, np.float32),
    )


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

    :param background: (size, size, 3) sRGB 0..1, which is drawn on
    :param samples: per pixel and direction, of what covers a pixel; light is computed once or a few times in each
    :param mm: millimetres of a unit of the scene
    """
    spots, over = seen(shader, size, samples)
    shader.prepare(spots.triangle if over is None else np.append(spots.triangle, over.triangle))
    encoded = (background.reshape(-1, 3) * 255 + 0.5).astype(np.uint8)
    drawn = np.zeros(size * size, bool)  # others, half of a portrait, are neither decoded nor encoded
    for pixels in (spots.pixel,) if over is None else (spots.pixel, over.veiled):
        drawn[pixels] = True
    at, place = np.flatnonzero(drawn), np.cumsum(drawn) - 1
    own = place.take(spots.pixel)
    uncovered = 1 - np.bincount(own, spots.share, len(at))
    picture = np.zeros((3, len(at)), np.float32)
    open_to = np.flatnonzero(uncovered)
    picture[:, open_to] = from_srgb(background.reshape(-1, 3).take(at[open_to], axis=0)).T * uncovered[open_to]
    if len(own):
        shaded = shader.shade(spots.triangle, spots.x, spots.y, grainy=shader.studio.soft)
        if shader.studio.soft:
            shaded = _softened(shaded, spots, size, shader.camera.focal, mm)
        for channel, color in zip(picture, shaded.toned(shader.studio.tone).T, strict=True):
            channel += np.bincount(own, color * spots.share, len(at))
    if over is not None:
        over.blend(picture, shader, place)
    encoded[at] = (to_srgb(picture) * 255 + 0.5).astype(np.uint8).T
    return encoded.reshape(size, size, 3)


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
    # names of triangles as the raster has them: of all samples, numbers and nearness took a fifth of a picture's time
    grid = raster.key.astype(np.uint32).reshape(-1, samples, width, samples)
    middle = samples // 2
    even = np.ones((grid.shape[0], width), bool)
    for y, x in np.ndindex(samples, samples):
        even &= grid[:, y, :, x] == grid[:, middle, :, middle]
    mixed = np.flatnonzero(~even)
    # (samples ** 2, p) of the pixels that show more than one triangle
    rows, columns = np.divmod(mixed, width)
    first = (rows * width * samples + columns) * samples
    steps = (np.arange(samples)[:, None] * width * samples + np.arange(samples)).reshape(-1, 1)
    some = Raster(key=raster.key.reshape(-1).take(first + steps))
    inner, near = some.triangle, some.nearness
    center = Raster(key=raster.key.reshape(grid.shape)[:, middle, :, middle]).triangle
    # pixels whose triangles are one smooth surface can be shaded at once
    shown = center.ravel().take(mixed)
    covered = (inner >= 0).all(axis=0)
    surface = shader.scene.surface
    plain = covered & (surface[inner] == surface[shown]).all(axis=0)
    at = np.flatnonzero(plain)
    facets, inner_at = shader.unit_facets, inner.take(at, axis=1)
    level, of_shown = np.full(len(at), 1.0, np.float32), facets.take(shown.take(at), axis=1)
    for sample in inner_at:
        level = np.minimum(level, (facets.take(sample, axis=1) * of_shown).sum(axis=0))
    depth = 1.0 / np.maximum(near.take(at, axis=1), 1e-12)
    step = np.ptp(depth, axis=0) * shader.camera.focal / depth.min(axis=0) if len(at) else level
    plain[at] = (level > _SMOOTH) & (step < _STEP)
    even.ravel()[mixed[plain]] = True
    once = np.flatnonzero(even & (center >= 0))
    # a spot for each triangle of pixels that show several: in the middle of the samples that it covers
    several_shown, edge_pixel = inner.T[~plain], mixed[~plain]
    which, of_pixel = np.nonzero(several_shown >= 0)
    triangle = several_shown[which, of_pixel].astype(np.int64)
    several = int(triangle.max(initial=0)) + 1
    code, spot, count = np.unique(which * several + triangle, return_inverse=True, return_counts=True)
    which, triangle = np.divmod(code, several)
    down, right = np.divmod(of_pixel, samples)
    edge_row, edge_column = np.divmod(edge_pixel[which], width)
    beside, below = (np.bincount(spot, (at + 0.5) / samples, len(code)) / np.maximum(count, 1) for at in (right, down))
    pixel = np.concatenate([once, edge_pixel[which]])
    order = np.argsort(pixel, kind="stable")
    row, column = np.divmod(once, width)
    return Spots(
        pixel=pixel[order] + top * width,
        triangle=np.concatenate([center.ravel()[once], triangle])[order],
        x=np.concatenate([column + 0.5, edge_column + beside])[order],
        y=np.concatenate([row + 0.5, edge_row + below])[order] + top,
        share=np.concatenate([np.ones(len(once)), count / samples**2])[order],
    )


def _softened(shaded: Shaded, spots: Spots, size: int, focal: float, mm: float) -> Shaded:
    """Samples with shadows free of grain, and with the light that comes to them below the surface."""
    row, column = np.divmod(spots.pixel, size)
    top, left = row.min(), column.min()
    shape = int(row.max() - top) + 1, int(column.max() - left) + 1  # of the part of the picture where things are
    place = (row - top) * shape[1] + column - left

    def image(values: FloatArray) -> Float32Array:
        return np.bincount(place, values, int(np.prod(shape))).reshape(shape).astype(np.float32)

    def read(pixels: Float32Array) -> Float32Array:
        return np.asarray(pixels.reshape(-1, *pixels.shape[2:]).take(place, axis=0))

    share, depth = image(spots.share), image(spots.share * shaded.depth)
    open_to = read(open_share(depth, share, _HOLLOW_MM / mm, focal))
    apart = np.abs(shaded.depth * read(share) - read(depth)) > _STEP / focal * shaded.depth
    open_to[apart] = 1.0  # edges before something farther away are no hollows
    values = image(spots.share * shaded.key_light)
    # (h, w) values without the grain of single pixels: means over 5 by 5 of them at about the same depth
    far = _mean(depth, share)
    hidden = read(_blurred(np.stack([values, share]), far, np.ones(3, np.float32), 8 * float(far.max()) / focal)[0])
    dimmed = {name: getattr(shaded.lit, name) * open_to[:, None] for name in ("diffuse", "highlights")}
    lit = replace(shaded.lit, **dimmed)
    shaded = replace(shaded, key_light=hidden * np.sqrt(open_to), lit=lit)
    light = np.stack([image(spots.share * channel) for channel in shaded.diffuse.T], axis=-1)
    change = read(spread(light, share, depth, _SCATTERED / mm, focal))
    return replace(shaded, scattered=scatter_share(shaded.base) * change)
