"""Where surfaces that pass through each other change places between two neighbouring pixels.

Hair and lashes stand in the skin, eyeballs in their sockets: such outlines are no edges of a mesh. Where the planes of
the two pixels' triangles change order between the centres, that place is the outline, and it moves with both of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from facepipe.learn.rasterise import Raster, corner_areas
from facepipe.learn.rows import take


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


def intersections(points: Tensor, triangles: Tensor, parts: Tensor, raster: Raster, taken: Tensor) -> Intersections:
    """The crossings of planes; without gradients. Only triangles of different connected parts are looked at.

    A line nearer to vertical counts between pixels side by side, the others between pixels above each other.

    :param points: (n, 3) pixel x, pixel y and depth
    :param triangles: (t, 3)
    :param parts: (t,) connected part of each triangle
    :param taken: numbers of pairs, as in `Crossings`, that are left out
    """
    with torch.no_grad():
        points = points.detach()
        shown = points.new_full((raster.height * raster.width,), -1, dtype=torch.int64)
        shown[raster.pixels] = raster.triangles
        inside, outside, pair = _borders(shown, parts, raster)
        free = ~torch.isin(pair, taken)
        inside, outside, steep = inside[free], outside[free], pair[free] % 2 == 1
        corners = triangles[torch.stack([shown[inside], shown[outside]], dim=1)]
        width = raster.width
        here, there = (_lead(points, corners, pixel, width) for pixel in (inside, outside))
        across = _lead(points, corners, inside + torch.where(steep, width, 1), width)
        keep = (here > 0) & (there < 0) & ((here - there) >= (here - across).abs())
        return Intersections(inside=inside[keep], outside=outside[keep], corners=corners[keep])


def _borders(shown: Tensor, parts: Tensor, raster: Raster) -> tuple[Tensor, Tensor, Tensor]:
    """Neighbouring pixels that show different parts, and the number of each pair."""
    part = torch.where(shown < 0, -1, parts[shown.clamp(min=0)]).reshape(raster.size)
    found = []
    for dim, step in ((1, 1), (0, raster.width)):
        one, other = (part.narrow(dim, start, max(part.shape[dim] - 1, 0)) for start in (0, min(1, part.shape[dim])))
        row, column = ((one != other) & (one >= 0) & (other >= 0)).nonzero().unbind(1)
        first = row * raster.width + column
        found.append(torch.stack([first, first + step, 2 * first + dim]))
    first, second, pair = torch.cat(found, dim=1)
    return first, second, pair


def _lead(points: Tensor, corners: Tensor, pixel: Tensor, width: int) -> Tensor:
    """(k,) by how much the plane of the first of two triangles (k, 2, 3) is nearer (1 / depth) than that of the other
    at a pixel's centre."""
    places = take(points, corners)
    x = places[..., 0] - (pixel % width + 0.5)[:, None, None]
    y = places[..., 1] - (pixel // width + 0.5)[:, None, None]
    areas = corner_areas(x, y)
    nearness = (areas / places[..., 2]).sum(dim=-1) / areas.sum(dim=-1)
    return nearness[:, 0] - nearness[:, 1]
