"""Which triangle each pixel shows, and what it shows of the triangle's attributes.

The first has no gradient: triangles become pixel spans, one per row of pixel centres that they cross, spans become
fragments, and the nearest fragment of each pixel wins. Edges that triangles share leave neither gaps nor double hits:
both find the crossing of an edge and a row with the same arithmetic, and spans are half open. The second is
interpolation with perspective-correct barycentric coordinates, which carry gradients (photo-to-face-sliders [0213]).
Gradients of what moves in front of what come from `facepipe.learn.antialias`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from facepipe.learn.camera import NEAR

ROWS_PER_CHUNK = 400_000
FRAGMENTS_PER_CHUNK = 1_000_000
FAR_OUT = 1e6  # pixels from the corner of the image beyond which positions lose their meaning
_FLAT = 1e-12  # squared pixels; twice the area of a triangle without one
_ID_MASK = 0xFFFFFFFF


def take(table: Tensor, rows: Tensor) -> Tensor:
    """(..., c) rows of a table (n, c).

    `gather`, whose gradient is a `scatter_add`: on a CPU several times as fast as that of indexing.
    """
    columns = table.shape[1]
    return table.gather(0, rows.reshape(-1, 1).expand(-1, columns)).reshape(*rows.shape, columns)


@dataclass(frozen=True, kw_only=True)
class Raster:
    """The visible triangle of each pixel that has one."""

    height: int
    width: int
    pixels: Tensor  # (p,) int64 numbers of the covered pixels, row by row, ascending
    triangles: Tensor  # (p,) int64 the triangle that each shows
    nearness: Tensor  # (height * width,) float32 1 / depth of what is visible, 0 where nothing is

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.height, self.width

    def paint(self, values: Tensor, background: Tensor) -> Tensor:
        """(height, width, c) image of values (p, c) at the covered pixels, and of a background elsewhere.

        :param background: (c,) or (height, width, c)
        """
        size = (self.height, self.width, values.shape[1])
        flat = background.expand(size).reshape(-1, values.shape[1])
        return flat.scatter(0, self.pixels[:, None].expand_as(values), values).reshape(size)


@dataclass(frozen=True, kw_only=True)
class _Spans:
    """Triangles on the screen, by column so that each step reads what it needs."""

    x: tuple[Tensor, Tensor, Tensor]  # (t,) of the corners, by y
    y: tuple[Tensor, Tensor, Tensor]
    nearness: Tensor  # (t,) 1 / depth at the first of the corners
    limits: tuple[Tensor, Tensor]  # (t,) least and largest nearness
    gradient: tuple[Tensor, Tensor]  # (t,) of nearness per pixel
    ids: Tensor  # (t,)


def rasterise(points: Tensor, triangles: Tensor, height: int, width: int) -> Raster:
    """The nearest triangle at the centre of every pixel, seen from either side; without gradients.

    Triangles with a corner that is not finite, nearer than `NEAR` or more than `FAR_OUT` pixels away are left out.
    Memory grows with pixels and triangles, never with how many pixels triangles cover: that work is done in chunks.

    :param points: (n, 3) pixel x, pixel y and depth
    :param triangles: (t, 3) int64 point numbers
    """
    with torch.no_grad():
        keys = torch.zeros(height * width, dtype=torch.int64, device=points.device)
        screen = _spans(points.detach(), triangles, height, width)
        for owner, row in _rows(screen, height):
            start, count = _columns(screen, owner, row, width)
            for part in _pieces(count, FRAGMENTS_PER_CHUNK):
                pixel, key = _fragments(screen, owner[part], row[part], start[part], count[part], width)
                keys.scatter_reduce_(0, pixel, key, "amax")
        covered = keys.nonzero()[:, 0]
        return Raster(
            height=height,
            width=width,
            pixels=covered,
            triangles=_ID_MASK - (keys[covered] & _ID_MASK),
            nearness=(keys >> 32).to(torch.int32).view(torch.float32),
        )


def barycentrics(points: Tensor, triangles: Tensor, raster: Raster) -> Tensor:
    """(p, 3) perspective-correct barycentric coordinates of the covered pixels' centres, with gradients to the points.

    The parts of the triangle's area across from each corner, over the corner's depth, scaled to sum to 1.
    """
    corners = take(points, triangles[raster.triangles])
    x = corners[..., 0] - (raster.pixels % raster.width + 0.5)[:, None]
    y = corners[..., 1] - (raster.pixels // raster.width + 0.5)[:, None]
    areas = corner_areas(x, y)
    areas = areas * torch.where(areas.detach().sum(dim=1, keepdim=True) < 0, -1.0, 1.0)
    over_depth = areas.clamp(min=0) / corners[..., 2]  # rounding leaves slivers' pixels a little outside
    total = over_depth.sum(dim=1, keepdim=True)
    thin = total <= 0
    return torch.where(thin, torch.full_like(over_depth, 1 / 3), over_depth / torch.where(thin, 1.0, total))


def facing(points: Tensor, triangles: Tensor, raster: Raster) -> Tensor:
    """(p, 1) 1 where a pixel shows the front of its triangle, counter-clockwise to the viewer, -1 at backs."""
    x, y, _ = take(points.detach(), triangles[raster.triangles]).unbind(-1)
    down = corner_areas(x - x[:, :1], y - y[:, :1]).sum(dim=1, keepdim=True)  # y points down: fronts are negative
    return torch.where(down > 0, -1.0, 1.0).to(points.dtype)


def corner_areas(x: Tensor, y: Tensor) -> Tensor:
    """(..., 3) twice the signed areas that the origin makes with the side across from each of the corners (..., 3)."""
    return x.roll(-1, -1) * y.roll(-2, -1) - x.roll(-2, -1) * y.roll(-1, -1)


def interpolate(values: Tensor, corners: Tensor, raster: Raster, weights: Tensor) -> Tensor:
    """(p, c) values at the covered pixels, from those of the visible triangles' corners.

    :param values: (v, c)
    :param corners: (t, 3) int64 rows of `values`: the triangles themselves, or face-varying ones
    :param weights: (p, 3) barycentric coordinates
    """
    return (take(values, corners[raster.triangles]) * weights[..., None]).sum(dim=1)


def _spans(points: Tensor, triangles: Tensor, height: int, width: int) -> _Spans:
    """The triangles that may cover a pixel's centre."""
    good = usable(points)
    x, y, nearness = take(torch.where(good[:, None], points, torch.ones_like(points)), triangles.T).unbind(-1)
    crossed = _crosses_centers(x, width) & _crosses_centers(y, height)
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    ids = (crossed & good[triangles].all(dim=1) & (area.abs() > _FLAT)).nonzero()[:, 0]
    x, y, area, nearness = x[:, ids], y[:, ids], area[ids], 1 / nearness[:, ids]
    along, across = nearness[1] - nearness[0], nearness[2] - nearness[0]
    gradient = (
        (along * (y[2] - y[0]) - across * (y[1] - y[0])) / area,
        (across * (x[1] - x[0]) - along * (x[2] - x[0])) / area,
    )
    order = y.argsort(dim=0)
    x, y, nearness = x.gather(0, order), y.gather(0, order), nearness.gather(0, order)
    return _Spans(
        x=x.unbind(0),
        y=y.unbind(0),
        nearness=nearness[0],
        limits=(nearness.amin(0), nearness.amax(0)),
        gradient=gradient,
        ids=ids,
    )


def _crosses_centers(positions: Tensor, size: int) -> Tensor:
    """(t,) bool: whether the span of corners (3, t) on one axis has a pixel's centre in it."""
    return first_center(positions.amin(0), size) < first_center(positions.amax(0), size)


def _rows(screen: _Spans, height: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Chunks of (triangle, row) for every row of pixel centres that a triangle crosses."""
    first = first_center(screen.y[0], height).long()
    count = first_center(screen.y[2], height).long() - first
    for part in _pieces(count, ROWS_PER_CHUNK):
        owner, step = expand(count[part])
        owner = owner + part.start
        yield owner, first.gather(0, owner) + step


def _columns(screen: _Spans, owner: Tensor, row: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """First column and number of columns of each (triangle, row)."""
    (x0, x1, x2), (y0, y1, y2) = (tuple(one.gather(0, owner) for one in corners) for corners in (screen.x, screen.y))
    at = row + 0.5
    upper = at < y1
    across = x0 + (at - y0) * (x2 - x0) / (y2 - y0)
    xa, ya = torch.where(upper, x0, x1), torch.where(upper, y0, y1)
    xb, yb = torch.where(upper, x1, x2), torch.where(upper, y1, y2)
    other = xa + (at - ya) * (xb - xa) / (yb - ya)
    start = first_center(torch.minimum(across, other), width).long()
    return start, first_center(torch.maximum(across, other), width).long() - start


def _fragments(
    screen: _Spans, owner: Tensor, row: Tensor, start: Tensor, count: Tensor, width: int
) -> tuple[Tensor, Tensor]:
    """Pixel numbers and keys of the spans' fragments; the larger key is the nearer one."""
    x, y, at_corner, by_x, by_y = (
        one.gather(0, owner) for one in (screen.x[0], screen.y[0], screen.nearness, *screen.gradient)
    )
    at_start = at_corner + (start + 0.5 - x) * by_x + (row + 0.5 - y) * by_y
    span, step = expand(count)
    pixel, nearness, slope, triangle = (one.gather(0, span) for one in (row * width + start, at_start, by_x, owner))
    least, most, number = (one.gather(0, triangle) for one in (*screen.limits, screen.ids))
    # Slivers have wild gradients; their nearness stays between that of their corners.
    nearness = torch.minimum(torch.maximum(nearness + slope * step, least), most)
    bits = nearness.to(torch.float32).view(torch.int32).long()
    return pixel + step, (bits << 32) | (_ID_MASK - number)


def usable(points: Tensor) -> Tensor:
    """(n,) bool: points (n, 3) that may be drawn, as in `rasterise`."""
    x, y, depth = points.unbind(1)
    return points.isfinite().all(dim=1) & (depth > NEAR) & (x.abs() < FAR_OUT) & (y.abs() < FAR_OUT)


def first_center(position: Tensor, size: int) -> Tensor:
    """The first pixel whose centre is at or beyond a position, 0 to size."""
    return (position - 0.5).ceil().clamp(0, size)


def expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (2, 3): owners 0 0 1 1 1 and steps 0 1 0 1 2."""
    owner = torch.repeat_interleave(counts)
    return owner, torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts).gather(0, owner)


def _pieces(counts: Tensor, limit: int) -> Iterator[slice]:
    """Slices whose counts add up to about `limit` at most, each with one entry at least."""
    ends = counts.cumsum(0)
    start = 0
    while start < len(counts):
        base = int(ends[start] - counts[start])
        stop = max(int(torch.searchsorted(ends, base + limit, right=True)), start + 1)
        yield slice(start, stop)
        start = stop
