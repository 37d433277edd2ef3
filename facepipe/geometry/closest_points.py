"""The nearest places of a triangulated surface to given points, exactly."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.vectors import cross_columns, dot_columns

# Where on its triangle a nearest place lies: at a corner, on the edge from corner 0 to 1, 1 to 2 or 2 to 0, or inside.
CORNER, EDGE, INSIDE = 0, 3, 6

_FIRST_NEIGHBOURS = 4  # triangles tried for every point at first
_PAIRS_AT_ONCE = 1 << 14  # point-triangle pairs at a time: what is computed of them stays in the processor's cache
_ROUNDING = 1e-9  # of a distance
_SIZE_STEP = 2.0  # triangles of one search tree differ in size by less than this factor


@dataclass(frozen=True)
class ClosestPlaces:
    """The nearest place of the surface to each of m points."""

    distances: FloatArray  # (m,)
    triangles: IntArray  # (m,)
    places: FloatArray  # (m, 3)
    features: IntArray  # (m,) CORNER + 0..2, EDGE + 0..2 or INSIDE


def closest_places(points: FloatArray, surface_points: FloatArray, triangles: IntArray) -> ClosestPlaces:
    """The nearest place of the surface `surface_points` (n, 3), `triangles` (t, 3), to each of `points` (m, 3).

    :raises InputError: no triangle, or one at a point that is not there
    """
    return SurfaceSearch(surface_points, triangles).closest(points)


class SurfaceSearch:
    """A surface to find nearest places of, again and again.

    Exact: a triangle is left out only where its bounding sphere lies further away than a place already found.
    Triangles without area count as the segments or points that they are.

    :param surface_points: (n, 3)
    :param triangles: (t, 3)
    :raises InputError: no triangle, or one at a point that is not there
    """

    def __init__(self, surface_points: FloatArray, triangles: IntArray) -> None:
        from scipy.spatial import cKDTree

        surface_points, triangles = np.asarray(surface_points, np.float64), np.asarray(triangles)
        if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(surface_points):
            what = f"{len(triangles)} triangles, expected at least one, all at points 0 to {len(surface_points) - 1}"
            raise InputError("surface", what)
        self._corners = _columns(surface_points, triangles)
        middles, sizes = _spheres(self._corners)
        centres = np.ascontiguousarray(middles.T)
        # groups of like size, the most numerous first: one large triangle widens the search for no others
        steps = np.floor(np.log(np.maximum(sizes, sizes.max() * 1e-6 + 1e-300)) / np.log(_SIZE_STEP))
        values, counts = np.unique(steps, return_counts=True)
        groups = [np.flatnonzero(steps == value) for value in values[np.argsort(-counts, kind="stable")]]
        self._groups = [_Group(members, sizes[members], cKDTree(centres[members])) for members in groups]

    def closest(self, points: FloatArray) -> ClosestPlaces:
        """The nearest place to each of `points` (m, 3)."""
        points = np.asarray(points, np.float64)
        nearest = _nothing(len(points))
        for group in self._groups if len(points) else ():
            members, largest = group.members, float(group.sizes.max())
            few = np.arange(1, min(_FIRST_NEIGHBOURS, len(members)) + 1)
            for part in np.array_split(np.arange(len(points)), -(-len(points) * len(few) // _PAIRS_AT_ONCE)):
                far, near = group.tree.query(points[part], k=few)
                row, column = np.nonzero(far - group.sizes[near] <= nearest.distances[part, None])
                _improve(nearest, points, self._corners, part[row], members[near[row, column]])
                # then all that may still come nearer: more and more neighbours took up to twice as long
                rest = part[far[:, -1] - largest <= nearest.distances[part]]
                reach = nearest.distances[rest] + largest
                counts = group.tree.query_ball_point(points[rest], reach, return_length=True)
                for some in np.split(np.arange(len(rest)), _cuts(counts)):
                    found = group.tree.query_ball_point(points[rest[some]], reach[some], return_sorted=False)
                    near = np.fromiter(itertools.chain.from_iterable(found), np.int64, int(counts[some].sum()))
                    numbers = np.repeat(rest[some], counts[some])
                    away = group.tree.data[near] - points[numbers]
                    reached = np.sqrt(np.einsum("pi,pi->p", away, away)) - group.sizes[near]
                    closer = reached <= nearest.distances[numbers]
                    _improve(nearest, points, self._corners, numbers[closer], members[near[closer]])
        return nearest


@dataclass(frozen=True)
class _Group:
    """Triangles of like size."""

    members: IntArray  # (g,)
    sizes: FloatArray  # (g,) radii of their bounding spheres
    tree: Any  # of the spheres' centres


def closest_among(
    points: FloatArray, surface_points: FloatArray, triangles: IntArray, owners: IntArray, candidates: IntArray
) -> ClosestPlaces:
    """The nearest place to each of `points` (m, 3) on triangles of its own; infinitely far for a point without any.

    :param owners: (p,) places in `points`
    :param candidates: (p,) triangles that these may lie on
    """
    nearest, points = _nothing(len(points)), np.asarray(points, np.float64)
    corners = _columns(surface_points, triangles)
    middles, sizes = _spheres(corners)
    if not (owners[1:] >= owners[:-1]).all():
        order = np.argsort(owners, kind="stable")
        owners, candidates = owners[order], candidates[order]
    for part in np.array_split(np.arange(len(owners)), -(-len(owners) // _PAIRS_AT_ONCE) or 1):
        numbers, tried = owners[part], candidates[part]
        # the middle of a triangle is a place of it: others may be nearer only where their sphere reaches as far, which
        # leaves a fifth of the triangles about a point
        away = middles.take(tried, axis=1) - points.T.take(numbers, axis=1)
        far = np.sqrt(dot_columns(away, away))
        starts = _starts(numbers)
        reach = np.repeat(np.minimum.reduceat(far, starts), np.diff(starts, append=len(far))) if len(far) else far
        near = np.flatnonzero(far - sizes[tried] <= reach * (1 + _ROUNDING))
        _improve(nearest, points, corners, numbers[near], tried[near])
    return nearest


def place_shares(nearest: ClosestPlaces, surface_points: FloatArray, triangles: IntArray) -> FloatArray:
    """(m, 3) barycentric shares of the corners of its triangle in every nearest place: 0 or more, in sum 1.

    A corner's share is the signed area of the triangle of the place and the other two corners, over the whole one's.
    """
    corners = _columns(surface_points, np.asarray(triangles)[nearest.triangles])
    normal = cross_columns(corners[1] - corners[0], corners[2] - corners[0])
    a, b, c = corners - nearest.places.T
    opposite = cross_columns(b, c), cross_columns(c, a), cross_columns(a, b)
    areas = np.maximum(np.stack([dot_columns(one, normal) for one in opposite], axis=1), 0.0)
    # on an edge and at a corner from that alone: by areas, rounding would leave a share where there is exactly none
    edge = (nearest.features >= EDGE) & (nearest.features < INSIDE)
    rows = np.flatnonzero(edge)
    first = nearest.features[rows] - EDGE
    starts, ends = corners[first, :, rows], corners[(first + 1) % 3, :, rows]
    sides = ends - starts
    along = ((nearest.places[rows] - starts) * sides).sum(axis=1) / np.maximum((sides * sides).sum(axis=1), 1e-300)
    areas[rows] = 0.0
    areas[rows, first], areas[rows, (first + 1) % 3] = 1.0 - np.clip(along, 0.0, 1.0), np.clip(along, 0.0, 1.0)
    corner = np.flatnonzero(nearest.features < EDGE)
    areas[corner] = np.eye(3)[nearest.features[corner] - CORNER]
    total = areas.sum(axis=1, keepdims=True)
    return np.where(total > 0, areas / np.where(total > 0, total, 1.0), 1.0 / 3.0)


def _nothing(count: int) -> ClosestPlaces:
    """No place yet for `count` points."""
    numbers = np.zeros((2, count), np.int64)
    return ClosestPlaces(np.full(count, np.inf), numbers[0], np.zeros((count, 3)), numbers[1])


def _columns(surface_points: FloatArray, triangles: IntArray) -> FloatArray:
    """(corners 3, axes 3, t): what is computed of many triangles runs along them, not along three numbers."""
    return np.ascontiguousarray(np.asarray(surface_points, np.float64)[np.asarray(triangles)].transpose(1, 2, 0))


def _cuts(counts: IntArray) -> IntArray:
    """Where rows of so many pairs each are cut, to have `_PAIRS_AT_ONCE` at a time, or one row."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS_AT_ONCE)) + 1


def _spheres(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles (3, t) of triangles (3, 3, t), and radii (t,) of spheres about them that hold these."""
    middles = corners.mean(axis=0)
    return middles, np.sqrt(((corners - middles) ** 2).sum(axis=1).max(axis=0))


def _starts(numbers: IntArray) -> IntArray:
    """Where runs of the same number (p,) begin."""
    return np.flatnonzero(np.concatenate([[True], numbers[1:] != numbers[:-1]])[: len(numbers)])


def _improve(
    nearest_places: ClosestPlaces, points: FloatArray, corners: FloatArray, numbers: IntArray, triangles: IntArray
) -> None:
    """Put in the places on `triangles` (p,) that are nearer to the points `numbers` (p,) than those found so far.

    :param corners: (3, 3, t)
    :param numbers: ascending
    """
    if not len(numbers):
        return
    wanted, tried = points.T.take(numbers, axis=1), corners.take(triangles, axis=2)
    squares, edge, share, lift = _reached(wanted, tried)
    # the nearest triangle of each point; of several that are as near, that of the lowest number
    starts = _starts(numbers)
    least = np.repeat(np.minimum.reduceat(squares, starts), np.diff(starts, append=len(squares)))
    first = np.flatnonzero(squares == least)
    first = first[np.lexsort((triangles[first], numbers[first]))]
    first = first[_starts(numbers[first])]
    point, distances = numbers[first], np.sqrt(squares[first])
    better = distances < nearest_places.distances[point]
    first, point = first[better], point[better]
    nearest_places.distances[point] = distances[better]
    nearest_places.triangles[point] = triangles[first]
    edge, share, lift, tried = edge[first], share[first], lift[first], tried[:, :, first]
    inside, rows = ~np.isnan(lift), np.arange(len(first))
    start, end = tried[edge, :, rows], tried[(edge + 1) % 3, :, rows]
    normals = cross_columns(tried[1] - tried[0], tried[2] - tried[1]).T
    on_edge = start + share[:, None] * (end - start)
    nearest_places.places[point] = np.where(inside[:, None], points[point] - lift[:, None] * normals, on_edge)
    on_edge_at = np.where(share <= 0, CORNER + edge, np.where(share >= 1, CORNER + (edge + 1) % 3, EDGE + edge))
    nearest_places.features[point] = np.where(inside, INSIDE, on_edge_at)


def _reached(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """How points (3, p) come nearest to triangles (3, 3, p): squared distances, edges, shares, lifts, (p,) each.

    The places of all pairs, which few need, and in rows of three numbers, took five times as long.
    The foot of the perpendicular, ``p - lift n``, where that lies inside, which it does where ``(side x (p - start)) .
    n > 0`` at all three sides; a lift is NaN where not, and the nearest place is ``start + share side`` of the edge.
    """
    sides = [corners[1] - corners[0], corners[2] - corners[1], corners[0] - corners[2]]
    normal = cross_columns(sides[0], sides[1])
    area = dot_columns(normal, normal)
    inside = area > 0  # without area the normal is 0 and nothing lies inside: the edges have the place
    for number, side in enumerate(sides):
        offset = points - corners[number]
        length = dot_columns(side, side)
        along = np.clip(dot_columns(offset, side) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        away = offset - along * side
        square = dot_columns(away, away)
        inside &= dot_columns(cross_columns(side, offset), normal) > 0
        if not number:
            squares, edge, share, lift = square, np.zeros(len(square), np.int64), along, dot_columns(offset, normal)
            continue
        nearer = square < squares
        squares[nearer], edge[nearer], share[nearer] = square[nearer], number, along[nearer]
    lift = np.where(inside, lift / np.where(inside, area, 1.0), np.nan)
    # not |p - place|^2: far from the origin, near the surface, that difference is rounding
    return np.where(inside, lift * lift * area, squares), edge, share, lift
