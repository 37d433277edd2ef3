"""The surface of a face for skinning: all meshes in one place and unit, cuts sewn, in connected components."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.geodesics import cells, even_triangles, surface_graph
from facepipe.geometry.polygons import (
    components,
    distinct_edges,
    edges,
    point_areas,
    point_normals,
    point_triangles,
    welded_points,
)
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts
from facepipe.rig.build_rig import mesh_spaces

LANDMARKS = "multipie68"
_SAME = 1e-6  # border points nearer than this share of the face's size are one
_EYES = (30.0, 300.0)  # mm from the outer corner of one eye to that of the other
_ACROSS = (20.0, 10000.0)  # mm, of a face without landmarks
_CORNERS = (36, 45)  # of multipie68


@dataclass(frozen=True, kw_only=True)
class Surface:
    """m sewn points of a face in its bind pose, in millimetres of the world, and what connects them."""

    where: str
    points: FloatArray  # (m, 3)
    triangles: IntArray  # (t, 3)
    cells: IntArray  # (c, 4) triangles and quads, as `geodesics.cells` gives them
    edges: IntArray  # (e, 2) of the polygons
    group: IntArray  # (n,) sewn point of every point of the face, meshes in stage order
    mesh: IntArray  # (m,) number of the mesh of each
    mesh_names: tuple[str, ...]
    component: IntArray  # (m,)
    main: int  # component that the landmarks lie on, or that has most points of triangles
    landmarks: IntArray | None  # (68,) sewn points of multipie68

    @cached_property
    def inside(self) -> IntArray:
        """Points of the main component."""
        return np.flatnonzero(self.component == self.main)

    @cached_property
    def loose(self) -> IntArray:
        """Points of all others."""
        return np.flatnonzero(self.component != self.main)

    @cached_property
    def normals(self) -> FloatArray:
        """(m, 3)."""
        return point_normals(self.points, self.triangles)

    @cached_property
    def graph(self) -> Any:
        """(m, m) lengths along the surface."""
        return surface_graph(self.points, self.cells, self.edges)

    @cached_property
    def even_triangles(self) -> IntArray:
        """(t, 3) with both diagonals of quads."""
        return even_triangles(self.cells)

    def part_triangles(self, points: IntArray, *, even: bool = False) -> IntArray:
        """(t, 3) triangles among `points`, as places in that list; `even`: with both diagonals of quads."""
        place = np.full(len(self.points), -1)
        place[points] = np.arange(len(points))
        found = place[self.even_triangles if even else self.triangles]
        return np.asarray(found[(found >= 0).all(axis=1)])


def surface_of(parts: FaceParts, where: str) -> Surface:
    """The surface of a face, as it was bound.

    :raises InputError: no triangle, or none with an area on its main part
    """
    to_world = np.asarray(parts.skeleton.transform, np.float64)
    millimetres = parts.meters_per_unit * 1000.0
    points: list[Any] = []
    triangles, faces, pairs, border, mesh_number = ([*points] for _ in range(5))
    start = 0
    for number, (mesh, space) in enumerate(zip(parts.meshes, mesh_spaces(parts), strict=True)):
        matrix = to_world @ space
        # millimetres of the world: all lengths of skinning are, whatever unit and transform a mesh has
        points.append(transformed(mesh.points, matrix) * millimetres)
        counts, indices = mesh.face_vertex_counts, mesh.face_vertex_indices
        triangles.append(point_triangles(counts, indices) + start)
        polygons = cells(counts, indices)
        faces.append(np.where(polygons >= 0, polygons + start, -1))
        ends, uses = edges(counts, indices)
        pairs.append(ends + start)
        at_border = np.zeros(len(mesh.points), bool)
        at_border[ends[uses == 1].ravel()] = True
        border.append(at_border)
        mesh_number.append(np.full(len(mesh.points), number))
        start += len(mesh.points)
    if not sum(map(len, triangles)):
        raise InputError(where, "no triangles, expected a surface to put weights on")
    whole = [np.concatenate(arrays) for arrays in (points, triangles, faces, pairs, border, mesh_number)]
    return _sewn(parts, where, *whole)


def _sewn(
    parts: FaceParts,
    where: str,
    points: FloatArray,
    triangles: IntArray,
    faces: IntArray,
    pairs: IntArray,
    border: Any,
    mesh: IntArray,
) -> Surface:
    # border points alone: closed lips touch inside a surface, and sewn they would share all weights
    group = welded_points(points, border, _SAME * float(np.ptp(points[triangles.ravel()], axis=0).max()))
    first = np.unique(group, return_index=True)[1]
    triangles, (pairs, *_) = group[triangles], distinct_edges(group[pairs])
    faces = np.where(faces >= 0, group[faces], -1)
    proper = (triangles != triangles[:, [1, 2, 0]]).all(axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    component = components(len(first), pairs)
    landmarks = _landmarks(parts, group)
    counted = component[np.unique(triangles[proper]) if landmarks is None else landmarks]
    made = Surface(
        where=where,
        points=points[first],
        triangles=triangles[proper],
        cells=faces,
        edges=pairs,
        group=group,
        mesh=mesh[first],
        mesh_names=tuple(mesh.name for mesh in parts.meshes),
        component=component,
        main=int(np.bincount(counted, minlength=1).argmax()),
        landmarks=landmarks,
    )
    if not point_areas(made.points, made.triangles)[made.inside].any():
        raise InputError(where, "no triangle with an area on its main part, expected a surface to put weights on")
    return made


def _landmarks(parts: FaceParts, group: IntArray) -> IntArray | None:
    start = 0
    for mesh in parts.meshes:
        found = mesh.landmarks.get(LANDMARKS)
        if found is not None and len(found.indices) == 68:
            return np.asarray(group[np.asarray(found.indices, np.int64) + start])
        start += len(mesh.points)
    return None


def size_warnings(surface: Surface) -> tuple[str, ...]:
    """A face whose size hints at the wrong metersPerUnit; lengths such as the radius of an eyeball count on it."""
    if surface.landmarks is None:
        across, (low, high), what = size_of(surface.points[surface.inside]), _ACROSS, "across"
    else:
        across = float(np.linalg.norm(np.subtract(*surface.points[surface.landmarks[list(_CORNERS)]])))
        (low, high), what = _EYES, "from eye to eye"
    if low <= across <= high:
        return ()
    return (f"the face is {across:.4g} mm {what}, expected {low:g} to {high:g}: its metersPerUnit may be wrong",)


def size_of(points: FloatArray) -> float:
    """Length of the diagonal of the box around (n, 3) points."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))
