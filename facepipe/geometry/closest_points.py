"""The nearest places of a triangulated surface to given points, exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError

# Where on its triangle a nearest place lies: at a corner, on the edge from corner 0 to 1, 1 to 2 or 2 to 0, or inside.
CORNER, EDGE, INSIDE = 0, 3, 6

_FIRST_NEIGHBOURS = 4  # triangles tried for every point at first
_PAIRS_AT_ONCE = 1 << 18  # point-triangle pairs at a time: a bound on memory
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
        self._corners = surface_points[triangles]
        centres = self._corners.mean(axis=1)
        sizes = np.sqrt(((self._corners - centres[:, None]) ** 2).sum(axis=2).max(axis=1))
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
            # more and more triangles of the group, for the points where a nearer one may still come
            members, largest = group.members, float(group.sizes.max())
            open_points, tried, count = np.arange(len(points)), 0, min(_FIRST_NEIGHBOURS, len(members))
            while len(open_points):
                reached = np.empty(len(open_points))
                for part in np.array_split(np.arange(len(open_points)), -(-len(open_points) * count // _PAIRS_AT_ONCE)):
                    numbers = open_points[part]
                    far, near = group.tree.query(points[numbers], k=np.arange(tried + 1, count + 1))
                    reached[part] = far[:, -1]
                    row, column = np.nonzero(far - group.sizes[near] <= nearest.distances[numbers, None])
                    _improve(nearest, points, self._corners, numbers[row], members[near[row, column]])
                if count == len(members):
                    break
                open_points = open_points[reached - largest <= nearest.distances[open_points]]
                tried, count = count, min(4 * count, len(members))
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
    nearest = _nothing(len(points))
    corners = np.asarray(surface_points, np.float64)[np.asarray(triangles)]
    for part in np.array_split(np.arange(len(owners)), -(-len(owners) // _PAIRS_AT_ONCE) or 1):
        _improve(nearest, np.asarray(points, np.float64), corners, owners[part], candidates[part])
    return nearest


def place_shares(nearest: ClosestPlaces, surface_points: FloatArray, triangles: IntArray) -> FloatArray:
    """(m, 3) barycentric shares of the corners of its triangle in every nearest place: 0 or more, in sum 1.

    A corner's share is the signed area of the triangle of the place and the other two corners, over the whole one's.
    """
    corners = np.asarray(surface_points, np.float64)[np.asarray(triangles)[nearest.triangles]]
    opposite = corners[:, [1, 2, 0]] - nearest.places[:, None], corners[:, [2, 0, 1]] - nearest.places[:, None]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.maximum(np.einsum("mci,mi->mc", np.cross(*opposite), normal), 0.0)
    # on an edge and at a corner from that alone: by areas, rounding would leave a share where there is exactly none
    edge = (nearest.features >= EDGE) & (nearest.features < INSIDE)
    rows = np.flatnonzero(edge)
    first = nearest.features[rows] - EDGE
    starts, ends = corners[rows, first], corners[rows, (first + 1) % 3]
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


def _improve(
    nearest_places: ClosestPlaces, points: FloatArray, corners: FloatArray, numbers: IntArray, triangles: IntArray
) -> None:
    """Put in the places on `triangles` (p,) that are nearer to the points `numbers` (p,) than those found so far."""
    wanted = points[numbers]
    tried = corners[triangles]
    # the foot of the perpendicular ``p - ((p - a) . n) n / |n|^2`` where that lies inside, which it does where
    # ``(side x (p - start)) . n > 0`` at all three sides; otherwise the nearest place on the three edges
    starts, ends = tried, tried[:, [1, 2, 0]]
    sides = ends - starts
    lengths = np.einsum("pei,pei->pe", sides, sides)
    offsets = wanted[:, None] - starts
    along = np.einsum("pei,pei->pe", offsets, sides) / np.where(lengths > 0, lengths, 1.0)
    along = np.clip(along, 0.0, 1.0)
    on_edges = starts + along[..., None] * sides
    edge_squares = ((wanted[:, None] - on_edges) ** 2).sum(axis=2)
    edge = edge_squares.argmin(axis=1)
    rows = np.arange(len(wanted))
    squares, places, share = edge_squares[rows, edge], on_edges[rows, edge], along[rows, edge]
    features = np.where(share <= 0, CORNER + edge, np.where(share >= 1, CORNER + (edge + 1) % 3, EDGE + edge))
    normals = np.cross(sides[:, 0], sides[:, 1])
    areas = np.einsum("pi,pi->p", normals, normals)
    # without area the normal is 0 and nothing lies inside: the edges have the place
    above = np.einsum("pei,pi->pe", np.cross(sides, offsets), normals)
    inside = (above > 0).all(axis=1) & (areas > 0)
    lift = np.einsum("pi,pi->p", offsets[:, 0], normals)[inside] / areas[inside]
    places[inside] = wanted[inside] - lift[:, None] * normals[inside]
    # not |p - place|^2: far from the origin, near the surface, that difference is rounding
    squares[inside] = np.einsum("p,p,p->p", lift, lift, areas[inside])
    features[inside] = INSIDE
    order = np.lexsort((triangles, squares, numbers))
    first = order[np.concatenate([[True], np.diff(numbers[order]) > 0])] if len(order) else order
    distances = np.sqrt(squares[first])
    point = numbers[first]
    better = distances < nearest_places.distances[point]
    first, point = first[better], point[better]
    nearest_places.distances[point] = distances[better]
    nearest_places.triangles[point] = triangles[first]
    nearest_places.places[point] = places[first]
    nearest_places.features[point] = features[first]
