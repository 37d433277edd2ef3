"""Where points of a face lie on another one that was warped onto it, lips on lips and lids on lids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.polygons import point_normals
from facepipe.processors.skin.slits import LOWER, UPPER, Slit
from facepipe.processors.skin.surface import Surface

_SIDE = 0.1  # of a slit's width from the line beside its corners: from there a point is on one side
_BESIDE = 1.0  # points up to so many widths from a rim look on their own side only
_FACING = 0.0  # cosine between normals from which places match
_TRIED = 48  # points looked at for one that faces the same way
_TURNED = 3.0  # a place that faces the same way may be so many times as far


@dataclass(frozen=True, kw_only=True)
class Places:
    """For each of k points a place on the other face."""

    corners: IntArray  # (k, 3) sewn points of the other face
    shares: FloatArray  # (k, 3) in sum 1
    distances: FloatArray  # (k,) mm

    def of(self, values: FloatArray) -> FloatArray:
        """(k, c) what of the values (m, c) at the other face's points is at the places."""
        return np.asarray(np.einsum("kc,kcj->kj", self.shares, values[self.corners]))


def main_places(
    target: Surface, target_slits: Sequence[Slit], source: Surface, source_slits: Sequence[Slit], warped: FloatArray
) -> Places:
    """Of the points of the main part the nearest places on the other's.

    :param warped: (m, 3) points of the source, warped onto the target
    """
    points = target.inside
    triangles = source.triangles[(source.component[source.triangles] == source.main).all(axis=1)]
    normals = point_normals(warped, triangles)
    found = _empty(len(points))
    for chosen, allowed in _sides(target, target_slits, source, source_slits, points, triangles):
        part = nearest(target.points[points[chosen]], warped, triangles[allowed])
        part = _turned(part, target, points[chosen], warped, normals, np.unique(triangles[allowed]))
        found.corners[chosen], found.shares[chosen] = part.corners, part.shares
        found.distances[chosen] = part.distances
    return found


def nearest(points: FloatArray, warped: FloatArray, triangles: IntArray) -> Places:
    """The nearest places on the triangles."""
    places = closest_places(points, warped, triangles)
    shares = place_shares(places, warped, triangles)
    return Places(corners=triangles[places.triangles], shares=shares, distances=places.distances)


def _empty(count: int) -> Places:
    return Places(corners=np.zeros((count, 3), np.int64), shares=np.zeros((count, 3)), distances=np.zeros(count))


def _sides(
    target: Surface,
    target_slits: Sequence[Slit],
    source: Surface,
    source_slits: Sequence[Slit],
    points: IntArray,
    triangles: IntArray,
) -> list[tuple[IntArray, IntArray]]:
    """Places in `points`, and the triangles that these may be on: all points once."""
    everywhere = np.arange(len(triangles))
    free = np.ones(len(points), bool)
    found = []
    for own, other in zip(target_slits, source_slits, strict=True):
        beside = own.distance[points] <= _BESIDE * own.width
        for sign in (UPPER, LOWER):
            chosen = free & beside & (sign * own.side[points] > _SIDE)
            wrong = (sign * other.side[triangles] < -_SIDE).any(axis=1)
            if chosen.any() and not wrong.all():
                found.append((np.flatnonzero(chosen), everywhere[~wrong]))
                free &= ~chosen
    return [*found, (np.flatnonzero(free), everywhere)]


def _turned(
    part: Places, target: Surface, points: IntArray, warped: FloatArray, normals: FloatArray, allowed: IntArray
) -> Places:
    """The places, but of points that face away from theirs a near point that faces as they do, where there is one."""
    from scipy.spatial import cKDTree

    own = target.normals[points]
    theirs = part.of(normals)
    rows = np.flatnonzero((own * theirs).sum(axis=1) <= _FACING)
    if not len(rows):
        return part
    count = min(_TRIED, len(allowed))
    away, near = cKDTree(warped[allowed]).query(target.points[points[rows]], k=np.arange(1, count + 1))
    facing = np.einsum("kni,ki->kn", normals[allowed[near]], own[rows]) > _FACING
    first = facing.argmax(axis=1)
    at = np.arange(len(rows))
    better = facing[at, first] & (away[at, first] <= _TURNED * np.maximum(part.distances[rows], 1.0))
    rows, first, at = rows[better], first[better], at[better]
    corners, shares, distances = part.corners.copy(), part.shares.copy(), part.distances.copy()
    corners[rows] = allowed[near[at, first]][:, None]
    shares[rows], distances[rows] = (1.0, 0.0, 0.0), away[at, first]
    return Places(corners=corners, shares=shares, distances=distances)
