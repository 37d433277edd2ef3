"""Where the silhouette edges of a mesh pass between the centres of neighbouring pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from facepipe.learn.rasterise import Raster, expand, usable
from facepipe.learn.rows import take

_ROUNDING = 1e-5  # of nearness; what is behind an edge is farther than this


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


def silhouettes(points: Tensor, edges: Tensor, raster: Raster) -> Crossings:
    """The visible crossings, at most one between two pixels; without gradients.

    :param points: (n, 3) pixel x, pixel y and depth
    :param edges: (e, 4) of an `Outline`
    """
    with torch.no_grad():
        return _visible(_crossings(points.detach(), edges, raster), points.detach(), raster)


def _crossings(points: Tensor, edges: Tensor, raster: Raster) -> Crossings:
    """All crossings of silhouette edges, seen or not, between two pixels of the image."""
    edges = edges[_silhouettes(points, edges)]
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
    steep, inward, slope = steep[owner], *(one[owner] for one in _sides(u, v, 1 / depth))
    one = torch.where(steep, line * raster.width + cell, cell * raster.width + line)
    other = one + torch.where(steep, 1, raster.width)
    nearness = 1 / depth[:, :2][owner]
    nearness = nearness[:, 0] + share * (nearness[:, 1] - nearness[:, 0])
    return Crossings(
        ends=edges[owner, :2],
        steep=steep,
        line=line,
        cell=cell,
        inside_first=inward < 0,
        pair=2 * one + steep,
        inside=torch.where(inward < 0, one, other),
        outside=torch.where(inward < 0, other, one),
        nearness=nearness,
        floor=nearness * (1 - _ROUNDING) + 2 * slope.clamp(max=0),
    )


def _silhouettes(points: Tensor, edges: Tensor) -> Tensor:
    """Numbers of the edges with all that is at them on one side of them, on the screen."""
    x, y, _ = take(points, edges.T).unbind(-1)
    dx, dy = x[1] - x[0], y[1] - y[0]
    one, other = (dx * (y[corner] - y[0]) - dy * (x[corner] - x[0]) for corner in (2, 3))
    outer = ((one > 0) & (other > 0)) | ((one < 0) & (other < 0))
    found = outer.nonzero()[:, 0]
    return found[usable(points)[edges[found]].all(dim=1)]


def _sides(u: Tensor, v: Tensor, nearness: Tensor) -> tuple[Tensor, Tensor]:
    """(e,) the direction in u from each edge to its surface, and the least change of nearness per pixel that way."""
    share = (v[:, 2:] - v[:, :1]) / (v[:, 1:2] - v[:, :1])
    inward = u[:, 2:] - (u[:, :1] + share * (u[:, 1:2] - u[:, :1]))
    change = nearness[:, 2:] - (nearness[:, :1] + share * (nearness[:, 1:2] - nearness[:, :1]))
    return inward[:, 0], (change / inward.abs()).amin(dim=1)


def _visible(found: Crossings, points: Tensor, raster: Raster) -> Crossings:
    """Those with the edge's surface on one side and what is behind it on the other; of several between two pixels the
    one that reaches farthest: all of them together cover that much."""
    inner, outer = raster.nearness[found.inside], raster.nearness[found.outside]
    seen = (outer < found.nearness * (1 - _ROUNDING)) & (inner > outer) & (inner >= found.floor)
    found = found.select(seen)
    order = torch.arange(len(found.pair), device=found.pair.device)
    reach = found.reach(points).clamp(min=0).to(torch.float32)
    keys = (reach.view(torch.int32).long() << 32) | order
    best = keys.new_zeros(2 * raster.height * raster.width).scatter_reduce_(0, found.pair, keys, "amax")
    return found.select(best[found.pair] == keys)
