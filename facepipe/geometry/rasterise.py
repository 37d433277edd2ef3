"""A z-buffer triangle rasteriser in numpy.

Triangles become pixel spans (one per row they cross), spans become fragments, and the nearest fragment of each pixel
wins. Every step runs on all triangles of a chunk at once, coordinate by coordinate. Edges that triangles share leave
neither gaps nor double hits: both find the crossing of an edge and a row with the same arithmetic, and spans are half
open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.geometry.vectors import cross_columns

KeyArray = npt.NDArray[np.uint64]

ROWS_PER_CHUNK = 16_000  # of which arrays stay in the processor's cache
FRAGMENTS_PER_CHUNK = 32_000
NEAR = 1e-6  # smallest homogeneous w that counts as in front of the camera
_ID_MASK = np.uint64(0xFFFFFFFF)


@dataclass(frozen=True, kw_only=True)
class ScreenTriangles:
    """Triangles on the screen that may cover a pixel's centre, clipped in front of the camera."""

    ids: IntArray  # (s,) the triangle each one is, or is a piece of
    x: FloatArray  # (3, s) pixels of the corners, sorted by y
    y: FloatArray  # (3, s) downward
    nearness: FloatArray  # (s,) at the first corner; larger is nearer
    limits: FloatArray  # (2, s) least and largest nearness of the corners
    gradient: FloatArray  # (2, s) of nearness per pixel in x and y

    def select(self, keep: BoolArray) -> ScreenTriangles:
        """Those whose triangle is marked in `keep` (t,)."""
        return self.take(np.flatnonzero(keep[self.ids]))

    def take(self, at: IntArray) -> ScreenTriangles:
        """Those in the places `at`, in that order."""
        return ScreenTriangles(**{each.name: getattr(self, each.name).take(at, axis=-1) for each in fields(self)})


@dataclass(frozen=True, kw_only=True)
class Raster:
    """The nearest triangle of each pixel, packed so that the larger key is the nearer one."""

    key: KeyArray  # (rows, width): float32 nearness bits, then the inverted triangle number; 0 where empty

    @property
    def triangle(self) -> npt.NDArray[np.int64]:
        """(rows, width) triangle number, -1 where there is none."""
        ids = (_ID_MASK - (self.key & _ID_MASK)).astype(np.int64)
        return np.where(self.key == 0, -1, ids)

    @property
    def nearness(self) -> Float32Array:
        """(rows, width) nearness, 0 where there is none. In perspective it is 1 / depth."""
        return (self.key >> np.uint64(32)).astype(np.uint32).view(np.float32)


@dataclass(frozen=True, kw_only=True)
class Spans:
    """Runs of pixels, each in one row of one triangle."""

    owner: IntArray  # (k,) into ScreenTriangles
    row: IntArray  # (k,)
    start: IntArray  # (k,) first column
    count: IntArray  # (k,) columns


def screen_triangles(points: FloatArray, triangles: IntArray) -> ScreenTriangles:
    """Triangles (t, 3) of homogeneous screen points, ready to rasterise.

    :param points: (n, 4) ``x w, y w, nearness w, w`` in pixels, nearness above 0; what has w below `NEAR` is cut off
    """
    if (points[:, 3] > NEAR).all():
        return crossing(np.stack([column / points[:, 3] for column in points[:, :3].T]), triangles)
    corners, ids = _clip(points[triangles], np.arange(len(triangles)))
    return on_screen(ids, *(corners[..., axis].T / corners[..., 3].T for axis in range(3)))


def crossing(points: FloatArray, triangles: IntArray) -> ScreenTriangles:
    """Triangles (t, 3) that lie in front of the camera, ready to rasterise.

    :param points: (3, n) pixels, x and then y downward, and nearness above 0; larger is nearer
    """
    ids, corner = np.arange(len(triangles)), np.ascontiguousarray(triangles.T)
    for axis in points[:2]:  # most triangles of a small picture cover no pixel's centre
        low, high = _extent(np.ceil(axis - 0.5).take(corner))
        some = np.flatnonzero(low < high)
        ids, corner = ids.take(some), corner.take(some, axis=1)
    return _ready(ids, *(axis.take(corner) for axis in points))


def on_screen(ids: IntArray, x: FloatArray, y: FloatArray, nearness: FloatArray) -> ScreenTriangles:
    """Triangles that lie in front of the camera, ready to rasterise.

    :param ids: (t,) their numbers
    :param x: (3, t) pixels of the corners
    :param y: (3, t) downward
    :param nearness: (3, t) above 0; larger is nearer
    """
    at = np.flatnonzero(_crosses_centers(x) & _crosses_centers(y))
    return _ready(ids[at], *(corner.take(at, axis=1) for corner in (x, y, nearness)))


def _ready(ids: IntArray, x: FloatArray, y: FloatArray, nearness: FloatArray) -> ScreenTriangles:
    """Triangles that may cover centres of pixels; takes the arrays over."""
    for low, high in ((0, 1), (1, 2), (0, 1)):
        swapped = y[low] > y[high]
        for corner in (x, nearness):
            corner[low], corner[high] = (
                np.where(swapped, corner[high], corner[low]),
                np.where(swapped, corner[low], corner[high]),
            )
        y[low], y[high] = np.minimum(y[low], y[high]), np.maximum(y[low], y[high])
    (ux, vx), (uy, vy), (un, vn) = (corner[1:] - corner[0] for corner in (x, y, nearness))
    area = ux * vy - uy * vx
    flat = np.flatnonzero(np.abs(area) <= 1e-12)
    area[flat] = np.inf
    y[2, flat] = y[0, flat]  # it crosses no row
    return ScreenTriangles(
        ids=ids,
        x=x,
        y=y,
        nearness=nearness[0],
        limits=np.stack(_extent(nearness)),
        gradient=np.stack([un * vy - vn * uy, vn * ux - un * vx]) / area,
    )


def rasterise(screen: ScreenTriangles, width: int, height: int, *, rows: tuple[int, int] | None = None) -> Raster:
    """The nearest triangle at the centre of every pixel.

    :param rows: half-open range of the rows to fill; None: all
    """
    top, bottom = rows or (0, height)
    key = np.zeros((bottom - top, width), np.uint64)
    names = _ID_MASK - screen.ids.astype(np.uint64)
    for owner, count, pixel, nearness in _fragments(screen, width, top, bottom):
        found = nearness.view(np.uint32).astype(np.uint64) << np.uint64(32)
        found |= names.take(owner).repeat(count)
        np.maximum.at(key.reshape(-1), pixel, found)
    return Raster(key=key)


def depths(screen: ScreenTriangles, width: int, height: int, *, far: bool = True) -> tuple[Float32Array, Float32Array]:
    """(height, width) nearness of what is nearest at the centre of every pixel, and with `far` of what is farthest.

    Where there is nothing, they are 0 and infinity.
    """
    nearest, farthest = (np.full((height, width), empty, np.float32) for empty in (0, np.inf))
    for _, _, pixel, nearness in _fragments(screen, width, 0, height):
        np.maximum.at(nearest.reshape(-1), pixel, nearness)
        if far:
            np.minimum.at(farthest.reshape(-1), pixel, nearness)
    return nearest, farthest


def spans_of(screen: ScreenTriangles, width: int, top: int, bottom: int) -> Iterator[Spans]:
    """The pixels whose centres triangles cover in a range of rows, in chunks; triangle by triangle, row by row."""
    first = np.clip(np.ceil(screen.y[0] - 0.5), top, bottom).astype(np.int64)
    last = np.clip(np.ceil(screen.y[2] - 0.5), top, bottom).astype(np.int64)
    hit = np.flatnonzero(last > first)
    # (3, s) x, y and dx over dy of the edges: from the first corner to the last, to the second, and from there. From
    # the upper corner down, so that both triangles at an edge have the same numbers.
    (x0, x1, x2), (y0, y1, y2) = screen.x, screen.y
    down = np.stack([y2 - y0, y1 - y0, y2 - y1])
    slope = (np.stack([x2 - x0, x1 - x0, x2 - x1]) / np.where(down > 0, down, 1)).ravel()
    x, y, counts = np.concatenate([x0, x0, x1]), np.concatenate([y0, y0, y1]), (last - first)[hit]
    for part in _pieces(counts, ROWS_PER_CHUNK):
        number, step = expand(counts[part])
        owner = hit[part].take(number)
        row = first.take(owner) + step
        at = (row + 0.5).astype(screen.x.dtype)
        short = owner + len(screen.ids) * np.where(at < y1.take(owner), 1, 2)
        across = x.take(owner) + (at - y.take(owner)) * slope.take(owner)
        other = x.take(short) + (at - y.take(short)) * slope.take(short)
        start = np.clip(np.ceil(np.minimum(across, other) - 0.5), 0, width).astype(np.int64)
        stop = np.clip(np.ceil(np.maximum(across, other) - 0.5), 0, width).astype(np.int64)
        some = np.flatnonzero(stop > start)
        yield Spans(owner=owner.take(some), row=row.take(some), start=start.take(some), count=(stop - start).take(some))


def barycentrics(points: FloatArray, triangles: IntArray, ids: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(m, 3) perspective-correct barycentrics of screen positions in the triangles numbered `ids` (m,).

    :param points: (n, 4) homogeneous screen points, as in `screen_triangles`
    """
    drawn = np.zeros(len(triangles), bool)
    drawn[ids] = True
    which = (np.cumsum(drawn) - 1).take(ids)
    return np.ascontiguousarray(shares(edge_planes(points, triangles[drawn]), which, x, y).T)


def edge_planes(points: FloatArray, triangles: IntArray) -> FloatArray:
    """(9, t) factors a, b, c for each corner of triangles (t, 3): ``a x + b y + c`` is its barycentric over depth.

    Olano and Greer 1997: the inverse of the matrix of homogeneous corners maps a pixel to barycentrics over depth.

    :param points: (n, 4) homogeneous screen points, as in `screen_triangles`
    """
    columns = np.ascontiguousarray(points[:, (0, 1, 3)].T)
    corners = [columns.take(each, axis=1) for each in triangles.T]
    planes = np.stack([cross_columns(corners[(k + 1) % 3], corners[(k + 2) % 3]) for k in range(3)])
    # Only ratios count; scaling keeps float32 in range, and a sign per triangle makes the three positive inside it.
    determinant = (planes[0] * np.stack(corners[0])).sum(axis=0)
    scale = np.abs(planes).max(axis=(0, 1)) * np.where(determinant < 0, -1.0, 1.0)
    planes /= np.where(scale == 0, 1.0, scale)
    return planes.reshape(9, -1)


def shares(planes: FloatArray, ids: IntArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(3, m) `barycentrics` by columns, of `edge_planes` made once."""
    x, y = x.astype(np.float64, copy=False), y.astype(np.float64, copy=False)
    over_depth = np.empty((3, len(ids)))
    for corner, value in enumerate(over_depth):
        a, b, c = planes[3 * corner : 3 * corner + 3]
        np.multiply(a.take(ids), x, out=value)
        value += b.take(ids) * y
        value += c.take(ids)
    np.maximum(over_depth, 0.0, out=over_depth)
    total = over_depth[0] + over_depth[1] + over_depth[2]
    thin = np.flatnonzero(total <= 0)
    over_depth[:, thin], total[thin] = 1.0, 3.0
    over_depth /= total
    return over_depth


def expand(counts: IntArray) -> tuple[IntArray, IntArray]:
    """The owner of each of `counts` (m,) steps and its number there: of (2, 3) owners 0 0 1 1 1, numbers 0 1 0 1 2."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts).take(owner)


def _crosses_centers(positions: FloatArray) -> BoolArray:
    """(t,) whether the extent of corners (3, t) on one axis has a pixel's centre in it."""
    low, high = _extent(positions)
    return np.asarray(np.ceil(low - 0.5) < np.ceil(high - 0.5))


def _extent(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(t,) least and largest of three rows; numpy's own reductions are slow over short axes."""
    a, b, c = corners
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


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


def _fragments(
    screen: ScreenTriangles, width: int, top: int, bottom: int
) -> Iterator[tuple[IntArray, IntArray, IntArray, Float32Array]]:
    """Chunks of fragments in a band of rows: owners and pixels of spans; flat number and nearness of each pixel."""
    for spans in spans_of(screen, width, top, bottom):
        for part in _pieces(spans.count, FRAGMENTS_PER_CHUNK):
            owner, row, start, count = (each[part] for each in (spans.owner, spans.row, spans.start, spans.count))
            slope, down = screen.gradient.take(owner, axis=1)
            first, (x, y) = screen.nearness.take(owner), (each[0].take(owner) for each in (screen.x, screen.y))
            first += (start + 0.5 - x) * slope + (row + 0.5 - y) * down
            # Slivers have wild gradients; their nearness stays between that of their corners.
            far = (count - 1).astype(first.dtype)
            low, high = screen.limits.take(owner, axis=1)
            first, last = (np.minimum(np.maximum(end, low), high) for end in (first, first + slope * far))
            slope = (last - first) / np.maximum(far, 1)
            ends = np.cumsum(count)
            begun, number = ends - count, np.arange(ends[-1] if len(ends) else 0)
            step = number.astype(first.dtype)
            step -= begun.astype(first.dtype).repeat(count)  # exact: a chunk's numbers are
            step *= slope.repeat(count)
            step += first.repeat(count)
            number += ((row - top) * width + start - begun).repeat(count)
            yield owner, count, number, step.astype(np.float32, copy=False)


def _pieces(counts: IntArray, limit: int) -> Iterator[slice]:
    """Slices whose counts add up to about `limit` at most, each with one entry at least."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        base = ends[start] - counts[start]
        stop = max(int(np.searchsorted(ends, base + limit, side="right")), start + 1)
        yield slice(start, stop)
        start = stop
