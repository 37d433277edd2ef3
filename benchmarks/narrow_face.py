"""The narrow face of the head in the box, and how far apart two people's are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.similarity import fit_similarity
from facepipe.heads import make

NARROW = 6706  # points of the narrow face of ICT-FaceKit, the first of the head's


class Apart(NamedTuple):
    """Mean distances of two faces, in the unit of their points."""

    surface: float  # from points to the other's surface, the mean of both ways
    points: float  # from points to the other's same ones


def narrow_triangles() -> IntArray:
    """(t, 3)."""
    mesh = make(0, textures=0).meshes[0]
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    return np.asarray(triangles[(triangles < NARROW).all(axis=1)])


def apart(one: FloatArray, other: FloatArray, triangles: IntArray) -> Apart:
    """How far (n, 3) points are from others, after the similarity that brings them closest in least squares.

    :param triangles: (t, 3) of both
    """
    moved = fit_similarity(one, other).apply(one)
    ways = ((moved, other), (other, moved))
    surface = [closest_places(points, surface, triangles).distances.mean() for points, surface in ways]
    return Apart(float(np.mean(surface)), float(np.linalg.norm(moved - other, axis=1).mean()))
