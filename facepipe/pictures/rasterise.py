"""A z-buffer triangle rasteriser in numpy.

Triangles become pixel spans (one per row they cross), spans become fragments, and the nearest fragment of each pixel
wins. Every step runs on all triangles of a chunk at once. Sharing an edge never leaves a gap or a double hit: both
triangles find the crossing of an edge and a row with the same arithmetic, and spans are half open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray

KeyArray = npt.NDArray[np.uint64]

ROWS_PER_CHUNK = 400_000
FRAGMENTS_PER_CHUNK = 1_000_000
NEAR = 1e-6  # smallest homogeneous w that counts as in front of the camera
_ID_MASK = np.uint64(0xFFFFFFFF)


@dataclass(frozen=True, kw_only=True)
class ScreenTriangles:
    """Triangles on the screen, corners sorted by y, clipped in front of the camera."""

    ids: IntArray  # (s,) the triangle each one is, or is a piece of
    xy: FloatArray  # (s, 3, 2) pixels, y down; sorted by y
    nearness: FloatArray  # (s,) at the first corner; larger is nearer
    limits: FloatArray  # (s, 2) least and largest nearness of the corners
    gradient: FloatArray  # (s, 2) of nearness per pixel in x and y

    def select(self, keep: npt.NDArray[np.bool_]) -> ScreenTriangles:
        """Those whose triangle is marked in `keep` (t,)."""
        at = np.flatnonzero(keep[self.ids])
        return ScreenTriangles(**{each.name: getattr(self, each.name)[at] for each in fields(self)})


@dataclass(frozen=True, kw_only=True)
class Raster:
    """The nearest triangle of each pixel, packed so that the larger key is the nearer one."""

    key: KeyArray  # (rows, width): float32 nearness bits, then the inverted triangle number; 0 where empty
    first_row: int = 0

    @property
    def triangle(self) -> npt.NDArray[np.int64]:
        """(rows, width) triangle number, -1 where there is none."""
        ids = (_ID_MASK - (self.key & _ID_MASK)).astype(np.int64)
        return np.where(self.key == 0, -1, ids)

    @property
    def nearness(self) -> npt.NDArray[np.float32]:
        """(rows, width) nearness, 0 where there is none. In perspective it is 1 / depth."""
        return (self.key >> np.uint64(32)).astype(np.uint32).view(np.float32)


def screen_triangles(points: FloatArray, triangles: IntArray) -> ScreenTriangles:
    """Triangles (t, 3) of homogeneous screen points, ready to rasterise.

    :param points: (n, 4) ``x w, y w, nearness w, w`` in pixels, nearness above 0; what has w below `NEAR` is cut off
    """
    corners, ids = _clip(points[triangles], np.arange(len(triangles)))
    w = corners[..., 3:]
    screen = corners[..., :3] / w
    order = np.argsort(screen[..., 1], axis=1, kind="stable")
    screen = np.take_along_axis(screen, order[..., None], axis=1)
    u, v = screen[:, 1] - screen[:, 0], screen[:, 2] - screen[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    kept = np.abs(area) > 1e-12
    ids, screen, u, v, area = ids[kept], screen[kept], u[kept], v[kept], area[kept]
    gradient = np.stack([u[:, 2] * v[:, 1] - v[:, 2] * u[:, 1], v[:, 2] * u[:, 0] - u[:, 2] * v[:, 0]], axis=1)
    low, high = (pick(pick(screen[:, 0, 2], screen[:, 1, 2]), screen[:, 2, 2]) for pick in (np.minimum, np.maximum))
    return ScreenTriangles(
        ids=ids,
        xy=screen[..., :2],
        nearness=screen[:, 0, 2],
        limits=np.stack([low, high], axis=1),
        gradient=np.asarray(gradient / area[:, None]),
    )


def rasterise(
    screen: ScreenTriangles,
    width: int,
    height: int,
    *,
    rows: tuple[int, int] | None = None,
    floor: KeyArray | None = None,
    ceiling: KeyArray | None = None,
) -> Raster:
    """The nearest triangle at the centre of every pixel.

    :param rows: half-open range of the rows to fill; None: all
    :param floor: (rows, width) keys that a triangle must be nearer than; they stay where none is
    :param ceiling: (rows, width) keys that a triangle must be farther than (depth peeling)
    """
    top, bottom = rows or (0, height)
    key = np.zeros((bottom - top, width), np.uint64) if floor is None else floor.copy()
    limit = None if ceiling is None else ceiling.ravel()
    flat = key.reshape(-1)
    for number, row in _crossings(screen, top, bottom):
        start, count = _spans(screen, number, row, width)
        for part in _pieces(count, FRAGMENTS_PER_CHUNK):
            if part.stop - part.start == 0:
                continue
            pixel, keys = _fragments(screen, number[part], row[part], start[part], count[part], top, width)
            if limit is not None:
                behind = keys < limit[pixel]
                pixel, keys = pixel[behind], keys[behind]
            np.maximum.at(flat, pixel, keys)
    return Raster(key=key, first_row=top)


def barycentrics(points: FloatArray, triangles: IntArray, ids: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(m, 3) perspective-correct barycentrics of screen positions in the triangles numbered `ids` (m,).

    Olano and Greer 1997: the inverse of the matrix of homogeneous corners maps a pixel to barycentrics over depth.

    :param points: (n, 4) homogeneous screen points, as in `screen_triangles`
    """
    used, which = np.unique(ids, return_inverse=True)
    corners = points[triangles[used]][..., (0, 1, 3)]
    planes = np.stack([np.cross(corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]) for i in range(3)], axis=1)
    # Only ratios count; scaling keeps float32 in range, and a sign per triangle makes the three positive inside it.
    determinant = np.einsum("ti,ti->t", planes[:, 0], corners[:, 0])
    scale = np.abs(planes).max(axis=(1, 2)) * np.where(determinant < 0, -1.0, 1.0)
    planes /= np.where(scale == 0, 1.0, scale)[:, None, None]
    at = planes[which.ravel()]
    over_depth = at[..., 0] * x[:, None] + at[..., 1] * y[:, None] + at[..., 2]
    over_depth = np.maximum(over_depth, 0.0)
    total = over_depth.sum(axis=1, keepdims=True)
    thin = total[:, 0] <= 0
    over_depth[thin], total[thin] = 1.0, 3.0
    return np.asarray(over_depth / total)


def _clip(corners: FloatArray, ids: IntArray) -> tuple[FloatArray, IntArray]:
    """Cut the triangles that pass through the plane w = NEAR; drop those behind it."""
    front = corners[..., 3] > NEAR
    if front.all():
        return corners, ids
    whole = front.all(axis=1)
    crossing = np.flatnonzero(front.any(axis=1) & ~whole)
    if not len(crossing):
        return corners[whole], ids[whole]
    pieces, owners = [corners[whole]], [ids[whole]]
    for count in (1, 2):
        chosen = crossing[front[crossing].sum(axis=1) == count]
        # Turn each triangle so that the odd corner out comes first.
        odd = np.argmax(front[chosen] == (count == 1), axis=1)
        turned = corners[chosen[:, None], (odd[:, None] + np.arange(3)) % 3]
        a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
        ab, ac = _cut(a, b), _cut(a, c)
        made = [np.stack([a, ab, ac], 1)] if count == 1 else [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]
        pieces += made
        owners += [ids[chosen]] * len(made)
    return np.concatenate(pieces), np.concatenate(owners)


def _cut(a: FloatArray, b: FloatArray) -> FloatArray:
    t = (NEAR - a[:, 3]) / (b[:, 3] - a[:, 3])
    cut = a + t[:, None] * (b - a)
    cut[:, 3] = NEAR
    return np.asarray(cut)


def _crossings(screen: ScreenTriangles, top: int, bottom: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Chunks of (triangle position, row) for every row centre inside a triangle's y range."""
    first = np.clip(np.ceil(screen.xy[:, 0, 1] - 0.5), top, bottom).astype(np.int64)
    last = np.clip(np.ceil(screen.xy[:, 2, 1] - 0.5), top, bottom).astype(np.int64)
    hit = np.flatnonzero(last > first)
    counts = (last - first)[hit]
    for part in _pieces(counts, ROWS_PER_CHUNK):
        number, step = _expand(counts[part])
        chosen = hit[part][number]
        yield chosen, first[chosen] + step


def _spans(screen: ScreenTriangles, number: IntArray, row: IntArray, width: int) -> tuple[IntArray, IntArray]:
    """First column and number of columns of each (triangle, row) crossing."""
    xy = screen.xy[number]
    y = row + 0.5
    upper = (y < xy[:, 1, 1])[:, None]
    across = _crossing_x(xy[:, 0], xy[:, 2], y)
    other = _crossing_x(np.where(upper, xy[:, 0], xy[:, 1]), np.where(upper, xy[:, 1], xy[:, 2]), y)
    start = np.clip(np.ceil(np.minimum(across, other) - 0.5), 0, width).astype(np.int64)
    stop = np.clip(np.ceil(np.maximum(across, other) - 0.5), 0, width).astype(np.int64)
    return start, stop - start


def _crossing_x(low: FloatArray, high: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(low[:, 0] + (y - low[:, 1]) * (high[:, 0] - low[:, 0]) / (high[:, 1] - low[:, 1]))


def _fragments(
    screen: ScreenTriangles, number: IntArray, row: IntArray, start: IntArray, count: IntArray, top: int, width: int
) -> tuple[IntArray, KeyArray]:
    """Flat pixel numbers and keys of the spans' fragments."""
    corner, gradient, limits = screen.xy[number, 0], screen.gradient[number], screen.limits[number]
    right, down = start + 0.5 - corner[:, 0], row + 0.5 - corner[:, 1]
    at_start = screen.nearness[number] + right * gradient[:, 0] + down * gradient[:, 1]
    span, step = _expand(count)
    # Slivers have wild gradients; their nearness stays between that of their corners.
    nearness = at_start[span] + gradient[:, 0][span] * step
    nearness = np.clip(nearness, limits[:, 0][span], limits[:, 1][span]).astype(np.float32)
    names = (_ID_MASK - screen.ids[number].astype(np.uint64))[span]
    keys = (nearness.view(np.uint32).astype(np.uint64) << np.uint64(32)) | names
    return ((row - top) * width + start)[span] + step, keys


def _expand(counts: IntArray) -> tuple[IntArray, IntArray]:
    """For counts (2, 3): owners 0 0 1 1 1 and steps 0 1 0 1 2."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def _pieces(counts: IntArray, limit: int) -> Iterator[slice]:
    """Slices whose counts add up to about `limit` at most, each with one entry at least."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        base = ends[start] - counts[start]
        stop = max(int(np.searchsorted(ends, base + limit, side="right")), start + 1)
        yield slice(start, stop)
        start = stop
