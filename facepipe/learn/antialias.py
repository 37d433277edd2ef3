"""Outlines blended by how far they reach between pixels: smooth images whose gradients move the outlines.

After the `antialias` primitive of Laine et al., "Modular Primitives for High-Performance Differentiable Rendering",
ACM TOG 39(6), 2020 (section 3.6): where the outline of a surface crosses between the centres of two pixels, one of the
two takes a share of the other's colour that is a linear function of where it crosses. Unlike there, crossings are found
from the silhouette edges of the mesh and not from the triangles that pixels show, so that triangles smaller than a
pixel count too, and surfaces may pass through each other. Lines nearer to vertical blend pixels side by side, the
others pixels above each other: each row or column then meets an outline once, and the sum over the image changes as
the covered area does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from facepipe.learn.intersections import intersections
from facepipe.learn.outline import Outline
from facepipe.learn.rasterise import Raster
from facepipe.learn.rows import take
from facepipe.learn.silhouettes import silhouettes


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
