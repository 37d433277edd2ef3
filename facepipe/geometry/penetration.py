"""How deep points lie in a triangulated surface."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.geometry.closest_points import CORNER, EDGE, INSIDE, closest_places
from facepipe.geometry.grouping import group_sums
from facepipe.geometry.vectors import unit_vectors

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


def penetration(points: FloatArray, surface_points: FloatArray, triangles: IntArray) -> FloatArray:
    """(m,) depth of `points` (m, 3) in the surface `surface_points` (n, 3), `triangles` (t, 3): above 0 inside.

    Its size is the exact distance from the surface. Its sign is that of the offset from the nearest place to the point
    along the pseudonormal there: that of the triangle, the sum of those at an edge, the angle-weighted sum at a
    corner. Exact for closed surfaces whose triangles turn counter-clockwise seen from outside and share their points
    by number; at an open border "inside" is behind the triangles there.

    Source: Baerentzen and Aanaes, "Signed distance computation using the angle weighted pseudonormal", IEEE TVCG 2005.

    :raises InputError: no triangle, or one at a point that is not there
    """
    points, surface_points = np.asarray(points, np.float64), np.asarray(surface_points, np.float64)
    triangles = np.asarray(triangles)
    nearest = closest_places(points, surface_points, triangles)
    at_triangles, at_edges, at_corners = _pseudonormals(surface_points, triangles)
    of, feature = nearest.triangles, nearest.features
    normals = at_triangles[of]
    edge = (feature >= EDGE) & (feature < INSIDE)
    normals[edge] = at_edges[of[edge], feature[edge] - EDGE]
    corner = feature < EDGE
    normals[corner] = at_corners[triangles[of[corner], feature[corner] - CORNER]]
    outward = np.einsum("mi,mi->m", points - nearest.places, normals)
    return np.asarray(np.where(outward < 0, nearest.distances, -nearest.distances) + 0.0)


def _pseudonormals(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit normals (t, 3) of the triangles, and pseudonormals of their edges (t, 3, 3) and of points (n, 3)."""
    corners = points[triangles]
    sides = corners[:, [1, 2, 0]] - corners
    normals = unit_vectors(np.cross(sides[:, 0], sides[:, 1]))
    pairs = np.sort(np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).reshape(-1, 2), axis=1)
    _, number = np.unique(pairs, axis=0, return_inverse=True)
    number = number.reshape(-1)  # numpy 2.0 gives it the shape of the pairs
    at_edges = group_sums(number, np.repeat(normals, 3, axis=0), int(number.max()) + 1)[number].reshape(-1, 3, 3)
    directions = unit_vectors(sides.reshape(-1, 3)).reshape(-1, 3, 3)
    cosines = -np.einsum("tei,tei->te", directions, directions[:, [2, 0, 1]])
    weighted = (np.arccos(np.clip(cosines, -1.0, 1.0))[..., None] * normals[:, None]).reshape(-1, 3)
    return normals, at_edges, group_sums(triangles.ravel(), weighted, len(points))
