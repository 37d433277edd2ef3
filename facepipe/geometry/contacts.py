"""What of teeth and eyeballs lies in front of skin that should hide it: rays from five views on a grid of 0.5 mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

Views = tuple[FloatArray, ...]

STEP = 0.5  # mm
_DEEPEST = 10.0  # mm; what lies farther behind a tooth is the other side of an open mouth
_SKIN_MARGIN = 15.0  # mm of skin around what it should hide
_EDGE_ON_AREA = 1e-9  # cells; triangles below this are seen edge-on
_ROUNDING_DEPTH = 0.01  # mm; less than this in front is rounding
_VIEWS = ((0, 0), (45, 0), (-45, 0), (0, 30), (0, -30))  # degrees to the left of the head, and up


@dataclass(frozen=True)
class Contact:
    """Rays that meet something hard before the skin that should hide it."""

    cells: int
    depth: float  # mm, the deepest; 0 where there is none


@dataclass(frozen=True)
class Sheet:
    """Skin, something hard behind it, and of the skin near that what is seen as long as nothing pokes through."""

    skin: IntArray  # (t, 3)
    outer: IntArray  # (s, 3)
    hard: IntArray  # (h, 3)

    @classmethod
    def of(cls, skin: IntArray, hard: IntArray, closed: Sequence[FloatArray]) -> Sheet:
        """The sheet whose outer part is the skin near `hard` that is seen in one of the poses `closed` (n, 3) mm."""
        seen = np.zeros(len(skin), bool)
        for points in closed:
            for view in five_views():
                grid = Grid.of(points @ view.T, hard)
                depth, number = grid.first(skin)
                seen[number[(number >= 0) & (depth > grid.first(hard)[0])]] = True
        rest = closed[0]
        low, high = (pick(rest[hard].reshape(-1, 3), axis=0) for pick in (np.min, np.max))
        near = rest[skin].mean(axis=1)
        kept = ((near > low - _SKIN_MARGIN) & (near < high + _SKIN_MARGIN)).all(axis=1)
        return cls(skin, skin[kept & seen], hard)

    def before_skin(self, points: FloatArray) -> Contact:
        """Where the hard part is seen up to `_DEEPEST` in front of outer skin; an open mouth shows teeth, and has none.

        What other skin hides, the inner side of a rolled lip, is not seen.
        """
        gaps = []
        for view in five_views():
            grid = Grid.of(points @ view.T, self.hard)
            front, outer = (grid.first(grid.front(triangles))[0] for triangles in (self.hard, self.outer))
            before = (front > outer) & (front > grid.first(self.skin)[0])
            gap = front[before] - outer[before]
            gaps.append(gap[(gap > _ROUNDING_DEPTH) & (gap < _DEEPEST)])
        return _contact(gaps)

    def through(self, points: FloatArray) -> Contact:
        """Where outer skin lies inside the hard part, which is what the ray meets first; made for eyeballs."""
        gaps = []
        for view in five_views():
            grid = Grid.of(points @ view.T, self.hard)
            front, back = grid.first(grid.front(self.hard))[0], grid.last(grid.back(self.hard))
            outer, skin = grid.first(grid.front(self.outer))[0], grid.first(self.skin)[0]
            inside = (front > skin) & (outer > back)
            gap = front[inside] - outer[inside]
            gaps.append(gap[gap > _ROUNDING_DEPTH])
        return _contact(gaps)

    def shown(self, points: FloatArray) -> FloatArray:
        """(5,) cells of the hard part that no skin hides, view by view."""
        cells = []
        for view in five_views():
            grid = Grid.of(points @ view.T, self.hard)
            cells.append((grid.first(self.hard)[0] > grid.first(self.skin)[0]).sum())
        return np.array(cells, np.float64)


def five_views() -> Views:
    """Rotations (3, 3) whose rows are right, up and towards the viewer."""
    found = []
    for left, up in np.radians(_VIEWS):
        towards = np.array([np.sin(left) * np.cos(up), np.sin(up), np.cos(left) * np.cos(up)])
        right = np.array([np.cos(left), 0.0, -np.sin(left)])
        found.append(np.stack([right, np.cross(towards, right), towards]))
    return tuple(found)


@dataclass(frozen=True)
class Grid:
    """Parallel rays over some triangles of a view; depth grows towards the viewer."""

    points: FloatArray  # (n, 3) mm in the view
    start: IntArray  # (2,) column and row of the first ray, in steps
    size: tuple[int, int]  # columns, rows

    @classmethod
    def of(cls, points: FloatArray, triangles: IntArray) -> Grid:
        """Rays over the bounding box of `triangles`."""
        flat = points[np.unique(triangles), :2] / STEP
        start, end = np.floor(flat.min(axis=0)).astype(np.int64), np.ceil(flat.max(axis=0)).astype(np.int64)
        return cls(points, start, (int(end[0] - start[0]) + 1, int(end[1] - start[1]) + 1))

    def front(self, triangles: IntArray) -> IntArray:
        """The triangles that face the viewer."""
        return triangles[self._area(triangles) > 0]

    def back(self, triangles: IntArray) -> IntArray:
        """The triangles that face away."""
        return triangles[self._area(triangles) < 0]

    def first(self, triangles: IntArray) -> tuple[FloatArray, IntArray]:
        """(cells,) depth of the nearest triangle, minus infinity where there is none, and its number or -1."""
        cell, number, depth = self._hits(triangles)
        nearest = np.full(self.size[0] * self.size[1], -np.inf)
        np.maximum.at(nearest, cell, depth)
        found = np.full(len(nearest), -1)
        top = depth == nearest[cell]
        found[cell[top]] = number[top]
        return nearest, found

    def last(self, triangles: IntArray) -> FloatArray:
        """(cells,) depth of the farthest triangle, infinity where there is none."""
        cell, _, depth = self._hits(triangles)
        farthest = np.full(self.size[0] * self.size[1], np.inf)
        np.minimum.at(farthest, cell, depth)
        return farthest

    def _area(self, triangles: IntArray) -> FloatArray:
        a, b, c = np.moveaxis(self.points[triangles, :2], 1, 0)
        return np.asarray((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])

    def _hits(self, triangles: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Cell, triangle and depth wherever a ray meets a triangle."""
        corners = self.points[triangles]
        flat = corners[..., :2] / STEP - self.start
        low = np.maximum(np.ceil(flat.min(axis=1)), 0).astype(np.int64)
        high = np.minimum(np.floor(flat.max(axis=1)), np.array(self.size) - 1).astype(np.int64)
        u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        extent = np.maximum(high - low + 1, 0) * (np.abs(area) > _EDGE_ON_AREA)[:, None]
        count = extent.prod(axis=1)
        number = np.repeat(np.arange(len(triangles)), count)
        place = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)
        xy = low[number] + np.stack([place % extent[number, 0], place // extent[number, 0]], axis=1)
        p = xy - flat[number, 0]
        # p = s u + t v by Cramer's rule; edges count, so that a ray on a common one meets both triangles, not neither
        s = (p[:, 0] * v[number, 1] - p[:, 1] * v[number, 0]) / area[number]
        t = (p[:, 1] * u[number, 0] - p[:, 0] * u[number, 1]) / area[number]
        inside = (s >= 0) & (t >= 0) & (s + t <= 1)
        number, xy, s, t = number[inside], xy[inside], s[inside], t[inside]
        z = corners[number, :, 2]
        depth = z[:, 0] + s * (z[:, 1] - z[:, 0]) + t * (z[:, 2] - z[:, 0])
        return xy[:, 1] * self.size[0] + xy[:, 0], number, depth


def _contact(gaps: Sequence[FloatArray]) -> Contact:
    every = np.concatenate(gaps)
    return Contact(cells=len(every), depth=float(every.max(initial=0.0)))
