"""The surface of a face for skinning: meshes in one place and unit, cuts sewn; its lips, lids and eyeballs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.balls import fit_ball
from facepipe.geometry.geodesics import cells, even_triangles, graph_distances, surface_graph
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
from facepipe.rig.rig import mesh_spaces

LANDMARKS = "multipie68"
_SAME = 1e-6  # border points nearer than this share of the face's size are one
_EYES = (30.0, 300.0)  # mm from the outer corner of one eye to that of the other
_ACROSS = (20.0, 10000.0)  # mm, of a face without landmarks
_CORNERS = (36, 45)  # of multipie68
# slit -> landmarks of multipie68 along the upper and the lower rim, without the corners, and the two corners
_RIMS = {
    "mouth": ((61, 62, 63), (65, 66, 67), (60, 64)),
    "eye_right": ((37, 38), (40, 41), (36, 39)),
    "eye_left": ((43, 44), (46, 47), (42, 45)),
}
_ON_PATH = 1e-6  # a point is on the shortest path between two if the way over it is longer by this share at most
UPPER, LOWER = 1, -1
_SMALLEST, _LARGEST = 6.0, 25.0  # mm, radius
_ROUND = 0.12  # largest rms distance from the ball, of its radius
_WHOLE = 0.75  # a ball's points reach at least this far around: (farthest apart / diameter)
_FEWEST = 20  # points
_INSIDE = 1.25  # other parts of the same mesh up to this many radii from the centre go with the ball


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


def surface_of(parts: FaceParts, where: str, layers: Sequence[int] = ()) -> Surface:
    """The surface of a face, as it was bound.

    :param layers: a number for each mesh: only those of one are sewn together; none: all are
    :raises InputError: no triangle, or none with an area on its main part
    """
    to_world = np.asarray(parts.skeleton.transform, np.float64)
    millimetres = parts.meters_per_unit * 1000.0
    points: list[Any] = []
    triangles, faces, pairs, border, mesh_number = ([*points] for _ in range(5))
    layers = layers or [0] * len(parts.meshes)
    start = 0
    for number, (mesh, space) in enumerate(zip(parts.meshes, mesh_spaces(parts), strict=True)):
        matrix = to_world @ space
        # millimetres of the world: all lengths of skinning are, whatever unit and transform a mesh has
        points.append(transformed(mesh.points, matrix) * millimetres)
        counts, indices = mesh.face_vertex_counts, mesh.face_vertex_indices
        corners = point_triangles(counts, indices) + start
        triangles.append(corners if np.linalg.det(matrix[:3, :3]) >= 0 else corners[:, ::-1])  # a mirror turns them
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
    return _sewn(parts, where, np.asarray(layers)[whole[5]], *whole)


def _sewn(
    parts: FaceParts,
    where: str,
    layer: IntArray,
    points: FloatArray,
    triangles: IntArray,
    faces: IntArray,
    pairs: IntArray,
    border: Any,
    mesh: IntArray,
) -> Surface:
    # border points alone: closed lips touch inside a surface, and sewn they would share all weights
    size = float(np.ptp(points[triangles.ravel()], axis=0).max())
    group = welded_points(points + 2.0 * size * layer[:, None], border, _SAME * size)  # layers far from one another
    first = np.unique(group, return_index=True)[1]
    triangles, (pairs, *_) = group[triangles], distinct_edges(group[pairs])
    faces = np.where(faces >= 0, group[faces], -1)
    proper = (triangles != triangles[:, [1, 2, 0]]).all(axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    component = components(len(first), pairs)
    landmarks, start = None, 0
    for one in parts.meshes:
        given = one.landmarks.get(LANDMARKS)
        if landmarks is None and given is not None and len(given.indices) == 68:
            landmarks = np.asarray(group[np.asarray(given.indices, np.int64) + start])
        start += len(one.points)
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


@dataclass(frozen=True, kw_only=True)
class Slit:
    """One slit: where its points lie, from -1 (below) over 0 (beside a corner) to 1 (above)."""

    name: str
    width: float  # mm, straight from corner to corner
    side: FloatArray  # (m,) difference of the distances from the two rims over the width; 0 off the main component
    distance: FloatArray  # (m,) mm along the surface from the nearer rim

    def share(self, side: int, blur: float) -> FloatArray:
        """(m,) how much a point is on `side`: 0 beyond -`blur`, 1 from `blur` on, smooth between."""
        return smoothstep((side * self.side / blur + 1.0) / 2.0)


def smoothstep(values: FloatArray) -> FloatArray:
    """0 up to 0, 1 from 1 on, smooth between."""
    t = np.clip(values, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def slits_of(surface: Surface) -> tuple[Slit, ...]:
    """Mouth and eyes of a face; none without landmarks."""
    if surface.landmarks is None:
        return ()
    slits, landmarks = [], surface.landmarks
    for name, (upper, lower, corners) in _RIMS.items():
        rows = [points_between(surface, landmarks[list(rim)]) for rim in (upper, lower)]
        above, below = graph_distances(surface.graph, rows)
        width = float(np.linalg.norm(np.subtract(*surface.points[landmarks[list(corners)]])))
        reached = np.isfinite(above) & np.isfinite(below)
        side = np.zeros(len(surface.points))
        side[reached] = np.clip((below[reached] - above[reached]) / max(width, np.finfo(np.float64).tiny), -1.0, 1.0)
        slits.append(Slit(name=name, width=width, side=side, distance=np.minimum(above, below)))
    return tuple(slits)


def points_between(surface: Surface, stations: IntArray) -> IntArray:
    """Points on the shortest paths from station to station."""
    away = graph_distances(surface.graph, [stations[[i]] for i in range(len(stations))])
    pieces = [stations]
    for i in range(len(stations) - 1):
        total = away[i, stations[i + 1]]
        if np.isfinite(total):
            pieces.append(np.flatnonzero(away[i] + away[i + 1] <= total * (1.0 + _ON_PATH)))
    return np.unique(np.concatenate(pieces))


@dataclass(frozen=True, kw_only=True)
class Eyeball:
    """A ball-shaped loose part, in millimetres."""

    centre: FloatArray  # (3,)
    radius: float
    points: IntArray  # its points, and those of parts of the same mesh in it


def eyeballs_of(surface: Surface) -> tuple[Eyeball, ...]:
    """The eyeballs of a face, by their first points."""
    areas = point_areas(surface.points, surface.triangles)
    eyeballs: list[Eyeball] = []
    for number in np.unique(surface.component[surface.loose]):
        points = np.flatnonzero(surface.component == number)
        if len(points) < _FEWEST or not areas[points].any():
            continue
        try:
            ball = fit_ball(surface.points[points], areas[points])
        except FitError:
            continue
        whole = np.ptp(surface.points[points], axis=0).min() >= _WHOLE * 2.0 * ball.radius
        is_ball = whole and _SMALLEST <= ball.radius <= _LARGEST and ball.rms <= _ROUND * ball.radius
        if not is_ball or any(np.isin(points[0], eyeball.points) for eyeball in eyeballs):
            continue
        # with it go the parts of its mesh that lie whole in it: iris, pupil, lens
        near = np.linalg.norm(surface.points - ball.centre, axis=1) <= _INSIDE * ball.radius
        same = (surface.mesh == surface.mesh[points[0]]) & (surface.component != surface.main)
        contents = same & near & ~np.isin(surface.component, np.unique(surface.component[same & ~near]))
        held = np.flatnonzero(contents | (surface.component == number))
        eyeballs.append(Eyeball(centre=ball.centre, radius=ball.radius, points=held))
    return tuple(eyeballs)
