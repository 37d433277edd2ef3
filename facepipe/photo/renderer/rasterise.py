"""Which triangle each pixel shows, and what it shows of the triangle's attributes.

The first has no gradient and is the rasteriser's of pictures. The second is interpolation with perspective-correct
barycentric coordinates, which carry gradients (photo-to-face-sliders [0213]). Gradients of what moves in front of what
come from `antialias` below.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facepipe.core.arrays import IntArray
from facepipe.geometry import rasterise as geometry
from facepipe.geometry.polygons import components, distinct_edges
from facepipe.photo.renderer.camera import NEAR

FAR_OUT = 1e6  # pixels from the corner of the image beyond which positions lose their meaning
_ROUNDING = 1e-5  # of nearness; what is behind an edge is farther than this


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
        """(height, width, c) values (p, c) at the covered pixels, a background (c,) or (height, width, c) elsewhere."""
        size = (self.height, self.width, values.shape[1])
        flat = background.expand(size).reshape(-1, values.shape[1])
        return flat.scatter(0, self.pixels[:, None].expand_as(values), values).reshape(size)


def rasterise(points: Tensor, triangles: Tensor, height: int, width: int) -> Raster:
    """The nearest of triangles (t, 3) at the centre of every pixel, seen from either side; without gradients.

    Triangles with a corner that is not finite, nearer than `NEAR` or more than `FAR_OUT` pixels away are left out.
    Points (n, 3) are pixel x, pixel y and depth.
    """
    good = usable(points.detach())
    chosen = triangles.cpu().numpy()
    if bool(good.all()):  # as a rule
        drawn = np.arange(len(chosen))
    else:
        drawn = good[triangles].all(dim=1).nonzero()[:, 0].cpu().numpy()
        chosen = chosen[drawn]
    corners = np.ascontiguousarray(chosen.T)
    x, y, depth = (np.ascontiguousarray(column)[corners] for column in points.detach().cpu().numpy().T)
    raster = geometry.rasterise(geometry.on_screen(drawn, x, y, 1 / depth), width, height)
    covered = np.flatnonzero(raster.key)
    pixels, shown, nearness = (
        torch.from_numpy(each).to(points.device)
        for each in (covered, raster.triangle.ravel()[covered], raster.nearness.ravel())
    )
    return Raster(height=height, width=width, pixels=pixels, triangles=shown, nearness=nearness)


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
    """(p, c) values (v, c) at the covered pixels by barycentric weights (p, 3), from the visible triangles' corners.

    :param corners: (t, 3) int64 rows of `values`: the triangles themselves, or face-varying ones
    """
    first, second, third = take(values, corners[raster.triangles]).unbind(dim=1)  # faster than sums over three
    return first * weights[:, :1] + second * weights[:, 1:2] + third * weights[:, 2:]


def usable(points: Tensor) -> Tensor:
    """(n,) bool: points (n, 3) that may be drawn, as in `rasterise`."""
    x, y, depth = points.unbind(1)
    return points.isfinite().all(dim=1) & (depth > NEAR) & (x.abs() < FAR_OUT) & (y.abs() < FAR_OUT)


def expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (2, 3): owners 0 0 1 1 1 and steps 0 1 0 1 2."""
    owner = torch.repeat_interleave(counts)
    return owner, torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts).gather(0, owner)


@dataclass(frozen=True, kw_only=True)
class Intersections:
    """Pairs of pixels that show parts which change order between the centres."""

    inside: Tensor  # (k,) pixel number
    outside: Tensor  # (k,) the pixel beside or below it
    corners: Tensor  # (k, 2, 3) points of the triangles that both show

    def reach(self, points: Tensor, width: int) -> Tensor:
        """(k,) how far, in pixels, the inner pixel's surface reaches from its centre, with gradients to the points."""
        lead = torch.stack([_lead(points, self.corners, pixel, width) for pixel in (self.inside, self.outside)])
        return lead[0] / (lead[0] - lead[1])


@torch.no_grad()  # type: ignore[untyped-decorator]
def intersections(points: Tensor, triangles: Tensor, parts: Tensor, raster: Raster, taken: Tensor) -> Intersections:
    """The crossings of planes; without gradients. Only triangles of different connected parts are looked at.

    A line nearer to vertical counts between pixels side by side, the others between pixels above each other. Points
    (n, 3) are pixel x, pixel y and depth; `parts` (t,) is the connected part of each triangle (t, 3).

    :param taken: numbers of pairs, as in `Crossings`, that are left out
    """
    shown = points.new_full((raster.height * raster.width,), -1, dtype=torch.int64)
    shown[raster.pixels] = raster.triangles
    part = torch.where(shown < 0, -1, parts[shown.clamp(min=0)]).reshape(raster.size)
    pairs = []
    for dim, step in ((1, 1), (0, raster.width)):
        one, other = (part.narrow(dim, start, max(part.shape[dim] - 1, 0)) for start in (0, min(1, part.shape[dim])))
        row, column = ((one != other) & (one >= 0) & (other >= 0)).nonzero().unbind(1)
        first = row * raster.width + column
        pairs.append(torch.stack([first, first + step, 2 * first + dim]))
    inside, outside, pair = torch.cat(pairs, dim=1)
    free = ~torch.isin(pair, taken)
    inside, outside, steep = inside[free], outside[free], pair[free] % 2 == 1
    corners = triangles[torch.stack([shown[inside], shown[outside]], dim=1)]
    width = raster.width
    here, there = (_lead(points, corners, pixel, width) for pixel in (inside, outside))
    # 1 / depth of a plane is affine on the screen: three leads give the line's slope, its root the crossing
    across = _lead(points, corners, inside + torch.where(steep, width, 1), width)
    keep = (here > 0) & (there < 0) & ((here - there) >= (here - across).abs())
    return Intersections(inside=inside[keep], outside=outside[keep], corners=corners[keep])


def _lead(points: Tensor, corners: Tensor, pixel: Tensor, width: int) -> Tensor:
    """(k,) by how much the plane of the first of two triangles (k, 2, 3) is nearer (1 / depth) than that of the other
    at a pixel's centre."""
    places = take(points, corners)
    x = places[..., 0] - (pixel % width + 0.5)[:, None, None]
    y = places[..., 1] - (pixel // width + 0.5)[:, None, None]
    areas = corner_areas(x, y)
    nearness = (areas / places[..., 2]).sum(dim=-1) / areas.sum(dim=-1)
    return nearness[:, 0] - nearness[:, 1]


@dataclass(frozen=True, kw_only=True)
class Crossings:
    """Places where a silhouette passes between the centres of two neighbouring pixels."""

    ends: Tensor  # (k, 2) points of the edge
    steep: Tensor  # (k,) bool: nearer to vertical, between pixels side by side
    line: Tensor  # (k,) the row (steep) or column that it crosses
    cell: Tensor  # (k,) the column (steep) or row of the first of the pixels
    inside_first: Tensor  # (k,) bool: the surface is on the side of the first
    pair: Tensor  # (k,) number of the pair of pixels: twice the first pixel's, and 1 more if they are side by side
    inside: Tensor  # (k,) pixel number on the surface's side
    outside: Tensor  # (k,) pixel number beyond the silhouette
    nearness: Tensor  # (k,) 1 / depth of the edge there
    floor: Tensor  # (k,) the least nearness of the surface at the inner pixel

    def select(self, keep: Tensor) -> Crossings:
        """Those of a mask or of numbers."""
        return Crossings(**{each.name: getattr(self, each.name)[keep] for each in fields(self)})

    def reach(self, points: Tensor) -> Tensor:
        """(k,) how far, in pixels, the surface reaches from the inner pixel's centre, with gradients to the points."""
        x, y = take(points[:, :2], self.ends).unbind(-1)
        u, v = torch.where(self.steep[:, None], x, y), torch.where(self.steep[:, None], y, x)
        along = u[:, 0] + (self.line + 0.5 - v[:, 0]) * (u[:, 1] - u[:, 0]) / (v[:, 1] - v[:, 0])
        reach = along - (self.cell + 0.5)
        return torch.where(self.inside_first, reach, 1 - reach)


@torch.no_grad()  # type: ignore[untyped-decorator]
def silhouettes(points: Tensor, edges: Tensor, raster: Raster) -> Crossings:
    """The visible crossings of silhouette edges, at most one between two pixels; without gradients.

    :param points: (n, 3) pixel x, pixel y and depth
    :param edges: (e, 4) of an `Outline`
    """
    x, y, _ = take(points, edges.T).unbind(-1)
    dx, dy = x[1] - x[0], y[1] - y[0]
    one, other = (dx * (y[corner] - y[0]) - dy * (x[corner] - x[0]) for corner in (2, 3))
    # a silhouette has all that is at it on one side of it, on the screen
    outer = (((one > 0) & (other > 0)) | ((one < 0) & (other < 0))).nonzero()[:, 0]
    edges = edges[outer[usable(points)[edges[outer]].all(dim=1)]]
    x, y, depth = points[edges].unbind(-1)
    steep = (y[:, 1] - y[:, 0]).abs() >= (x[:, 1] - x[:, 0]).abs()
    u, v = torch.where(steep[:, None], x, y), torch.where(steep[:, None], y, x)
    lines, cells = (
        torch.where(steep, *size) for size in ((raster.height, raster.width), (raster.width, raster.height))
    )
    low, high = ((v[:, :2] - 0.5).ceil().amin(1), (v[:, :2] - 0.5).ceil().amax(1))
    first, last = (torch.minimum(one.clamp(min=0), lines).long() for one in (low, high))
    owner, step = expand(last - first)
    line = first[owner] + step
    share = (line + 0.5 - v[owner, 0]) / (v[owner, 1] - v[owner, 0])
    # On a centre, as in the raster: the pixel belongs to what comes after the edge.
    cell = (u[owner, 0] + share * (u[owner, 1] - u[owner, 0]) - 0.5).ceil().long() - 1
    within = ((cell >= 0) & (cell + 1 < cells[owner])).nonzero()[:, 0]
    owner, line, share, cell = owner[within], line[within], share[within], cell[within]
    # the direction in u from each edge to its surface, and the least change of nearness per pixel that way
    over_depth, part = 1 / depth, (v[:, 2:] - v[:, :1]) / (v[:, 1:2] - v[:, :1])
    towards = u[:, 2:] - (u[:, :1] + part * (u[:, 1:2] - u[:, :1]))
    change = over_depth[:, 2:] - (over_depth[:, :1] + part * (over_depth[:, 1:2] - over_depth[:, :1]))
    steep, inward, slope = steep[owner], towards[:, 0][owner], (change / towards.abs()).amin(dim=1)[owner]
    near = torch.where(steep, line * raster.width + cell, cell * raster.width + line)
    far = near + torch.where(steep, 1, raster.width)
    nearness = 1 / depth[:, :2][owner]
    nearness = nearness[:, 0] + share * (nearness[:, 1] - nearness[:, 0])
    crossings = Crossings(
        ends=edges[owner, :2],
        steep=steep,
        line=line,
        cell=cell,
        inside_first=inward < 0,
        pair=2 * near + steep,
        inside=torch.where(inward < 0, near, far),
        outside=torch.where(inward < 0, far, near),
        nearness=nearness,
        floor=nearness * (1 - _ROUNDING) + 2 * slope.clamp(max=0),
    )
    # those with the edge's surface on one side and what is behind it on the other; of several between two pixels the
    # one that reaches farthest: all of them together cover that much
    inner, outer = raster.nearness[crossings.inside], raster.nearness[crossings.outside]
    seen = (outer < crossings.nearness * (1 - _ROUNDING)) & (inner > outer) & (inner >= crossings.floor)
    crossings = crossings.select(seen)
    order = torch.arange(len(crossings.pair), device=crossings.pair.device)
    reach = crossings.reach(points).clamp(min=0).to(torch.float32)
    keys = (reach.view(torch.int32).long() << 32) | order
    best = keys.new_zeros(2 * raster.height * raster.width).scatter_reduce_(0, crossings.pair, keys, "amax")
    return crossings.select(best[crossings.pair] == keys)


@dataclass(frozen=True, kw_only=True)
class Outline:
    """The topology that `antialias` needs, made once a mesh."""

    triangles: Tensor  # (t, 3) int64
    edges: Tensor  # (e, 4) int64: both ends, then the corners across from it in the triangles on its sides
    parts: Tensor  # (t,) int64 number of the connected part that each triangle belongs to

    @classmethod
    def from_triangles(cls, triangles: IntArray, point_count: int) -> Outline:
        """The outline of triangles (t, 3)."""
        triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        part = components(point_count, np.concatenate([triangles[:, :2], triangles[:, 1:]]))
        numbers = (triangles, mesh_edges(triangles), part[triangles[:, 0]].astype(np.int64))
        one, other, last = map(torch.as_tensor, numbers)
        return cls(triangles=one, edges=other, parts=last)


def mesh_edges(triangles: IntArray) -> npt.NDArray[np.int64]:
    """(e, 4) edges of triangles (t, 3): both ends, then the corners across from it in the triangles on its sides.

    An edge of one triangle has its corner twice. Edges of more than two are left out: they lie inside a surface.
    """
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    ends = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    across = np.concatenate([triangles[:, (i + 2) % 3] for i in range(3)])
    pairs, owner, count = distinct_edges(ends)
    order = np.argsort(owner, kind="stable")
    last = np.cumsum(count) - 1
    edges = np.column_stack([pairs, across[order[last - count + 1]], across[order[last]]])
    return np.asarray(edges[count <= 2])


def antialias(image: Tensor, points: Tensor, outline: Outline, raster: Raster) -> Tensor:
    """(height, width, c) image with its outlines blended, with gradients to colours and points.

    :param image: (height, width, c) colours of what `raster` shows
    :param points: (n, 3) pixel x, pixel y and depth, those that were rasterised
    """
    edges = silhouettes(points, outline.edges, raster)
    planes = intersections(points, outline.triangles, outline.parts, raster, edges.pair)
    inside, outside = torch.cat([edges.inside, planes.inside]), torch.cat([edges.outside, planes.outside])
    past = torch.cat([edges.reach(points), planes.reach(points, raster.width)]) - 0.5
    flat = image.reshape(-1, image.shape[2])
    change = past[:, None] * (take(flat, inside) - take(flat, outside))
    changed = torch.where(past.detach() < 0, inside, outside)
    return flat.scatter_add(0, changed[:, None].expand_as(change), change).reshape(image.shape)
