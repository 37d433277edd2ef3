"""Where on a fitted template each point of a head lies: never across a slit, never on a sheet that faces away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.closest_points import ClosestPlaces, closest_among, closest_places, place_shares
from facepipe.geometry.polygons import triangle_normals
from facepipe.scanning.transfer.mesh import HeadMesh

REACH_MM = 4.0  # points farther from the template than that are not on it: hair, clothes, another inner mouth
_FACING = 0.0  # cosine between normals: a place that faces away is on another sheet, such as the inside of a lip
_CANDIDATES = 48  # triangles, the nearest by their middles, that are tried for points whose nearest place faces away


@dataclass(frozen=True, kw_only=True)
class Places:
    """A place on the template's skin for each of s points."""

    corners: IntArray  # (s, 3) rows
    shares: FloatArray  # (s, 3)
    distances: FloatArray  # (s,) infinite where there is none

    def of(self, values: FloatArray) -> FloatArray:
        """(s, ...) values (rows, ...) there."""
        return np.asarray(np.einsum("sc,sc...->s...", self.shares, values[self.corners]))


def nearest_places(rows: FloatArray, triangles: IntArray, head: HeadMesh) -> Places:
    """The nearest places of a surface, rows (r, 3) and triangles (t, 3), to a head's points, on whichever side."""
    nothing = np.zeros(len(rows), np.int64), np.zeros(len(head.points), np.int64)
    return places_on(rows, triangles, head, *nothing)


def places_on(rows: FloatArray, triangles: IntArray, head: HeadMesh, labels: IntArray, sides: IntArray) -> Places:
    """The nearest places of a surface, rows (r, 3) and triangles (t, 3), to a head's points, that face as these do.

    Points farther off than `REACH_MM` may find none: those of a body below are as far from a thousand triangles as from
    the nearest, and each of these would be tried.

    :param labels: (r,) +a and -a of the sides of slit a
    :param sides: (s,) the same of the head's points: one of +a finds no place on a triangle with a corner of -a
    """
    from scipy.spatial import cKDTree

    points, normals = head.points, head.normals
    largest = float(np.linalg.norm(rows[triangles] - rows[triangles[:, [1, 2, 0]]], axis=2).max())
    near = np.isfinite(cKDTree(rows).query(points, distance_upper_bound=REACH_MM + largest)[0])
    count = len(points)
    corners, shares, distances = np.zeros((count, 3), np.int64), np.zeros((count, 3)), np.full(count, np.inf)
    of_corners = labels[triangles]
    facing = triangle_normals(rows, triangles)
    for side in np.unique(sides):
        numbers = np.flatnonzero(near & (sides == side))
        allowed = np.flatnonzero((of_corners != -side).all(axis=1)) if side else np.arange(len(triangles))
        if not (len(allowed) and len(numbers)):
            continue
        nearest = facing_places(rows, triangles[allowed], facing[allowed], points[numbers], normals[numbers])
        corners[numbers] = triangles[allowed[nearest.triangles]]
        shares[numbers], distances[numbers] = place_shares(nearest, rows, triangles[allowed]), nearest.distances
    return Places(corners=corners, shares=shares, distances=distances)


def facing_places(
    rows: FloatArray, triangles: IntArray, facing: FloatArray, points: FloatArray, normals: FloatArray
) -> ClosestPlaces:
    """The nearest places that face as the points (p, 3) with normals (p, 3) do; where none of the nearest
    `_CANDIDATES` triangles does, their distance is infinite.

    :param facing: (t, 3) normals of `triangles`
    """
    from scipy.spatial import cKDTree

    nearest = closest_places(points, rows, triangles)
    away = np.flatnonzero(_turned(facing[nearest.triangles], normals))
    if not len(away):
        return nearest
    count = min(_CANDIDATES, len(triangles))
    _, near = cKDTree(rows[triangles].mean(axis=1)).query(points[away], k=np.arange(1, count + 1))
    owner, column = np.nonzero(np.einsum("pci,pi->pc", facing[near], normals[away]) > _FACING)
    other = closest_among(points[away], rows, triangles, owner, near[owner, column])
    for name in ("distances", "triangles", "places", "features"):
        getattr(nearest, name)[away] = getattr(other, name)
    return nearest


def _turned(facing: FloatArray, normals: FloatArray) -> BoolArray:
    return np.asarray(np.einsum("si,si->s", facing, normals) <= _FACING)
