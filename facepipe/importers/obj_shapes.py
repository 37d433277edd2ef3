"""Sets of OBJ files on one topology: a neutral and its shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.importers.wavefront import Obj, read_obj


def read_offsets(path: Path, neutral: Obj) -> FloatArray:
    """(n, 3) float64: points of the shape at `path` minus the neutral's.

    :raises InputError: the file can't be read
    :raises TopologyError: its points or faces aren't those of the neutral
    """
    shape = read_obj(path)
    check_topology(path, neutral, shape)
    return np.asarray(shape.points - neutral.points)


def check_topology(path: Path, neutral: Obj, shape: Obj) -> None:
    """Check that `shape` has the points and faces of `neutral`; a shape without any faces is taken as it is.

    :raises TopologyError: the first thing that differs
    """
    if len(shape.points) != len(neutral.points):
        raise TopologyError(path, f"{len(shape.points)} points, expected {len(neutral.points)} as in the neutral")
    counts, expected = shape.face_vertex_counts, neutral.face_vertex_counts
    if len(counts) == 0 or _same_faces(neutral, shape):
        return
    if len(counts) != len(expected):
        raise TopologyError(path, f"{len(counts)} faces, expected {len(expected)} as in the neutral")
    face = _first_different_face(neutral, shape)
    raise TopologyError(
        path, f"face {face + 1} has points {_points(shape, face)}, expected {_points(neutral, face)} as in the neutral"
    )


def _same_faces(neutral: Obj, shape: Obj) -> bool:
    return np.array_equal(shape.face_vertex_counts, neutral.face_vertex_counts) and np.array_equal(
        shape.face_vertex_indices, neutral.face_vertex_indices
    )


def _first_different_face(neutral: Obj, shape: Obj) -> int:
    different = shape.face_vertex_counts != neutral.face_vertex_counts
    first = int(np.argmax(different)) if different.any() else len(different)
    corners = int(neutral.face_vertex_counts[:first].sum())
    unequal = shape.face_vertex_indices[:corners] != neutral.face_vertex_indices[:corners]
    if unequal.any():
        ends = np.cumsum(neutral.face_vertex_counts)
        return int(np.searchsorted(ends, int(np.argmax(unequal)), side="right"))
    return first


def _points(obj: Obj, face: int) -> list[int]:
    start = int(obj.face_vertex_counts[:face].sum())
    return [int(i) + 1 for i in obj.face_vertex_indices[start : start + int(obj.face_vertex_counts[face])]]
