"""A painter of region maps: the UV layout filled triangle by triangle, as an artist's bake would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from facepipe.geometry.polygons import triangulate
from facepipe.parts import Mesh

COLORS = np.array(
    [
        (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (255, 0, 255), (0, 255, 255), (128, 64, 0),
        (240, 240, 240), (0, 80, 40), (90, 0, 160),
    ],
    np.uint8,
)  # fmt: skip


def legend_of(names: list[str], **more: object) -> dict[str, Any]:
    """A legend: the names in the order of `COLORS`."""
    return {"regions": {name: COLORS[number].tolist() for number, name in enumerate(names)}, **more}


def paint(mesh: Mesh, size: int, *, tile: tuple[int, int] = (0, 0)) -> np.ndarray[Any, Any]:
    """(size, size, 4) map: every texel whose centre lies in a UV triangle has the colour of the region with most
    there, masks interpolated; the rest is transparent."""
    masks = np.stack([np.asarray(mask, np.float64) for mask in mesh.regions.values()], axis=1)
    uv_set = mesh.uv_sets[0]
    corners = triangulate(mesh.face_vertex_counts).corners
    points = np.asarray(mesh.face_vertex_indices)[corners]
    uv = np.asarray(uv_set.values, np.float64)[points if uv_set.indices is None else uv_set.indices[corners]] - tile
    image = np.zeros((size, size, 4), np.uint8)
    for place, masks_here in zip(uv, masks[points], strict=True):
        xy = np.stack([place[:, 0], 1 - place[:, 1]], axis=1) * size - 0.5  # texel centres at whole numbers
        if not ((xy > -1).all() and (xy < size).all()):
            continue
        low, high = np.ceil(xy.min(axis=0)).astype(int), np.floor(xy.max(axis=0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        edges = np.stack([xy[1] - xy[0], xy[2] - xy[0]], axis=1)
        if not x.size or abs(np.linalg.det(edges)) < 1e-12:
            continue
        shares = np.linalg.solve(edges, np.stack([x.ravel() - xy[0, 0], y.ravel() - xy[0, 1]]))
        weights = np.stack([1 - shares.sum(axis=0), shares[0], shares[1]], axis=1)
        inside = (weights >= -1e-9).all(axis=1)
        region = (weights[inside] @ masks_here).argmax(axis=1)
        image[y.ravel()[inside], x.ravel()[inside]] = np.column_stack([COLORS[region], np.full(len(region), 255)])
    return image


def save(image: np.ndarray[Any, Any], path: Path) -> Path:
    """The pixels as a PNG."""
    from PIL import Image

    Image.fromarray(image).save(path)
    return path
