"""Which triangle each pixel shows, and what it shows of the triangle's attributes.

The first has no gradient and is the rasteriser's of pictures. The second is interpolation with perspective-correct
barycentric coordinates, which carry gradients (photo-to-face-sliders [0213]). Gradients of what moves in front of what
come from `facepipe.photo.renderer.antialias`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facepipe.geometry import rasterise as geometry
from facepipe.photo.renderer.camera import NEAR

FAR_OUT = 1e6  # pixels from the corner of the image beyond which positions lose their meaning


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


def rasterise(points: Tensor, triangles: Tensor, height: int, width: int) -> Raster:
    """The nearest triangle at the centre of every pixel, seen from either side; without gradients.

    Triangles with a corner that is not finite, nearer than `NEAR` or more than `FAR_OUT` pixels away are left out.

    :param points: (n, 3) pixel x, pixel y and depth
    :param triangles: (t, 3) int64 point numbers
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
    """(p, c) values at the covered pixels, from those of the visible triangles' corners.

    :param values: (v, c)
    :param corners: (t, 3) int64 rows of `values`: the triangles themselves, or face-varying ones
    :param weights: (p, 3) barycentric coordinates
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
