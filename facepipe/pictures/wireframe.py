"""The edges of a face over a picture, without those that the surface hides."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from facepipe.core.arrays import ByteArray, FloatArray, IntArray
from facepipe.geometry.polygons import edges
from facepipe.geometry.rasterise import NEAR, rasterise, screen_triangles
from facepipe.parts import FaceParts
from facepipe.pictures.scene import build_scene

if TYPE_CHECKING:
    from PIL.Image import Image

Samples = TypeVar("Samples", ByteArray, FloatArray)

FINE = 3  # samples per pixel and direction: lines are three samples, one pixel, wide
SLACK = 2e-4  # of the depth: a point is hidden by what is nearer by more than that
LONG, SHORT = 7.0, 0.25  # pixels from which edges are drawn in full; opacity of the shortest


def wireframe(parts: FaceParts, screen: FloatArray, size: tuple[int, int]) -> Image:
    """How much of each pixel is covered by visible edges: a mask of `size` (width, height), 8 bits.

    Short edges are fainter, so that a dense mesh gives a tone, no blot.

    :param screen: (n, 3) pixel x, pixel y (down) and depth of the points of all meshes, in mesh order
    """
    from PIL import Image

    width, height = size[0] * FINE, size[1] * FINE
    scene = build_scene(parts, None)
    points = np.asarray(screen, dtype=np.float64) * (FINE, FINE, 1.0)
    solid = scene.triangles[~scene.see_through]
    # (e, 2) polygon edges of opaque surfaces between points that face the camera and are in front of it
    (ax, ay), (bx, by), (cx, cy) = points[solid.T, :2].transpose(0, 2, 1)
    ahead = (points[solid, 2] > NEAR).all(axis=1)
    facing = ahead & ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0)  # y points down
    seen = np.zeros(len(points), dtype=bool)
    seen[solid[facing]] = True
    meshes: list[IntArray] = [np.zeros((0, 2), np.int64)]
    start = 0
    for mesh in parts.meshes:
        meshes.append(edges(mesh.face_vertex_counts, mesh.face_vertex_indices)[0] + start)
        start += len(mesh.points)
    pairs = np.concatenate(meshes)
    pairs = np.asarray(pairs[seen[pairs].all(axis=1)])
    cover = np.zeros((height, width), np.uint8)
    if len(pairs):
        depth = np.maximum(points[:, 2:], NEAR / 2)
        homogeneous = np.hstack([points[:, :2] * depth, np.ones_like(depth), depth])
        nearness = rasterise(screen_triangles(homogeneous, solid), width, height).nearness
        farthest = _nearby(np.minimum, nearness)  # steep surfaces must not hide their own edges
        ends = points[pairs]
        # set the samples along edges (e, 2, 3) where nothing is nearer
        rows, columns = cover.shape
        low, high = ends[..., :2].min(axis=1), ends[..., :2].max(axis=1)
        ends = ends[(high > 0).all(axis=1) & (low < (columns, rows)).all(axis=1)]
        length = np.linalg.norm(ends[:, 1, :2] - ends[:, 0, :2], axis=1)
        count = np.minimum(np.ceil(length), 4 * (columns + rows)).astype(np.int64) + 1
        which = np.repeat(np.arange(len(ends)), count)
        share = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)) / np.maximum(count - 1, 1)[which]
        at = ends[which, 0, :2] * (1 - share[:, None]) + ends[which, 1, :2] * share[:, None]
        line_nearness = (1 - share) / ends[which, 0, 2] + share / ends[which, 1, 2]
        column, row = np.floor(at).astype(np.int64).T
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        column, row, line_nearness, which = column[inside], row[inside], line_nearness[inside], which[inside]
        clear = line_nearness >= farthest[row, column] * (1 - SLACK)
        tone = np.clip(length / FINE / LONG, SHORT, 1.0)[which] * 255
        np.maximum.at(cover, (row[clear], column[clear]), np.rint(tone[clear]).astype(np.uint8))
    return Image.fromarray(_nearby(np.maximum, cover)).reduce(FINE)


def _nearby(extreme: np.ufunc, samples: Samples) -> Samples:
    """The extreme of each sample (h, w) and its neighbours, with 0 around all of them."""
    padded = np.pad(samples, 1)
    rows = extreme(extreme(padded[:-2], padded[1:-1]), padded[2:])
    return np.asarray(extreme(extreme(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]))
