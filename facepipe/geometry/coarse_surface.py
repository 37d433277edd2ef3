"""Large surfaces and clouds as small surfaces to look at: points of a grid's cells as one, small discs for clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, small_holes
from facepipe.geometry.vectors import group_sums, unit_vectors

_DISC_CORNERS = 6  # corners


@dataclass(frozen=True, kw_only=True)
class Look:
    """A surface with what a picture of it needs."""

    points: FloatArray  # (n, 3)
    triangles: IntArray  # (t, 3)
    normals: FloatArray  # (n, 3) unit length
    colors: FloatArray | None = None  # (n, 3) linear


def coarse_look(look: Look, cell: float) -> Look:
    """The surface with one point for each cell of a grid that has some; `cell` is its side."""
    group = grid_groups(look.points, cell)
    count = int(group.max()) + 1
    share = 1.0 / np.bincount(group)[:, None]
    points = group_sums(group, look.points, count) * share
    triangles = group[look.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    return Look(
        points=points,
        triangles=triangles,
        normals=unit_vectors(group_sums(group, look.normals, count)),
        colors=None if look.colors is None else group_sums(group, look.colors, count) * share,
    )


def grid_groups(points: FloatArray, cell: float) -> IntArray:
    """(n,) the number of the cell that each of points (n, 3) lies in, of a grid's cells that have some."""
    numbers = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    spans = numbers.max(axis=0) + 1
    key = (numbers[:, 0] * spans[1] + numbers[:, 1]) * spans[2] + numbers[:, 2]
    return np.asarray(np.unique(key, return_inverse=True)[1].reshape(-1))


def surface_look(points: FloatArray, triangles: IntArray, colors: FloatArray | None) -> Look:
    """A surface as it is."""
    return Look(points=points, triangles=triangles, normals=point_normals(points, triangles), colors=colors)


def disc_look(points: FloatArray, normals: FloatArray, radii: FloatArray, colors: FloatArray | None) -> Look:
    """A disc at each point of a cloud, across its normal."""
    other = np.eye(3)[np.abs(normals).argmin(axis=1)]
    right = unit_vectors(np.cross(normals, other))
    up = np.cross(normals, right)
    turn = 2 * np.pi * np.arange(_DISC_CORNERS) / _DISC_CORNERS
    rim = np.cos(turn)[:, None] * right[:, None] + np.sin(turn)[:, None] * up[:, None]
    corners = points[:, None] + radii[:, None, None] * rim
    fan = np.array([[0, i, i + 1] for i in range(1, _DISC_CORNERS - 1)])
    triangles = (np.arange(len(points))[:, None, None] * _DISC_CORNERS + fan).reshape(-1, 3)
    return Look(
        points=corners.reshape(-1, 3),
        triangles=triangles,
        normals=np.repeat(normals, _DISC_CORNERS, axis=0),
        colors=None if colors is None else np.repeat(colors, _DISC_CORNERS, axis=0),
    )


def part_look(look: Look, kept: BoolArray) -> Look:
    """The triangles whose points are all `kept` (n,)."""
    triangles = look.triangles[kept[look.triangles].all(axis=1)]
    used, triangles = np.unique(triangles, return_inverse=True)
    return Look(
        points=look.points[used],
        triangles=triangles.reshape(-1, 3),
        normals=look.normals[used],
        colors=None if look.colors is None else look.colors[used],
    )


def filled_look(look: Look, largest: float) -> Look:
    """The surface with a fan of triangles over each hole of at most `largest` across: see `small_holes`."""
    loops = small_holes(look.points, look.triangles, largest)
    if not loops:
        return look
    fans = [
        np.stack([loop, np.roll(loop, -1), np.full(len(loop), len(look.points) + number)], axis=1)
        for number, loop in enumerate(loops)
    ]

    def with_means(values: FloatArray) -> FloatArray:
        return np.concatenate([values, [values[loop].mean(axis=0) for loop in loops]])

    return Look(
        points=with_means(look.points),
        triangles=np.concatenate([look.triangles, *fans]),
        normals=unit_vectors(with_means(look.normals)),
        colors=None if look.colors is None else with_means(look.colors),
    )
