"""What skin may touch: eyeballs, teeth, gums and the other lip, as surfaces in any pose of any face of one topology."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.balls import RadialSurface, fit_ball
from facepipe.geometry.closest_points import closest_among, place_shares
from facepipe.geometry.geodesics import graph_distances, surface_graph
from facepipe.geometry.polygons import border_points, point_areas, point_normals
from facepipe.geometry.similarity import fit_similarity
from facepipe.geometry.vectors import unit_vectors
from facepipe.geometry.winding_numbers import WindingNumbers
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME
from facepipe.verbs.blend.graph import Graph
from facepipe.verbs.blend.sources import Sources

_ROUND = 0.1  # RMS distance from a ball, in radii, up to which a part counts as an eyeball
_LARGE = 0.5  # area of a component, relative to the largest of its part, from which on it may be the outer shell
_AROUND = 2.0  # radii from an eyeball's centre within which skin is looked at
_NEAR_MM = 30.0  # from teeth and gums at rest within which skin is looked at: jaws open as far
_DEEPEST_MM = 3.0  # from a surface up to which skin is in it, not behind it
_NEAREST = 6  # points of a surface whose triangles are looked at: of 4, one place in 2,000 is not the nearest
_STEEP = 0.7  # height above the nearest point's plane, of its distance, from which on a place is outside; deep: 0.46
_LIPS_MM = 16.0  # from the outer lips' landmarks, along the skin: what may meet the other lip
_OFF_MM = 0.02  # from skin, where it is asked whether that lies in flesh
_INSIDE = 0.25  # winding number: of open sheets it is -0.5 to 0 at their outside, and 1 more in flesh
_FLESH_MM = 8.0  # from skin, from which on flesh is as coarse as cells that are wider the farther it is
_CELL = 0.75  # their width, of the distance where they begin; at each double of that they are twice as wide
_JOINED_MM = 3.0  # along the skin from the other lip: lips that are joined there, at corners
_HARD = ("teeth", "tooth", "gum")  # in names of meshes
_UPPER, _LOWER, _CORNERS = [49, 50, 51, 52, 53], [55, 56, 57, 58, 59], [48, 54]  # landmarks of the outer lips


@dataclass(frozen=True, eq=False)
class Body:
    """What skin may touch: its surface, of points that are counted over all meshes, and the skin around it."""

    name: str
    points: IntArray  # (p,)
    triangles: IntArray  # (t, 3) into `points`
    skin: IntArray  # (s,)
    ball: IntArray | None = None  # (q,) all points of an eyeball, which is met along rays from its centre
    facing: IntArray | None = None  # (f, 3) triangles into `skin`, of lips
    # (f, 3) the triangles of the face, far ones coarse, of a lip: it is skin too, and gives way
    flesh: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))

    @property
    def soft(self) -> bool:
        """Whether it is a lip."""
        return len(self.flesh) > 0

    @cached_property
    def flesh_surface(self) -> tuple[IntArray, IntArray]:
        """The flesh's points (p,) and its triangles (f, 3) into these."""
        points, places = np.unique(self.flesh, return_inverse=True)
        return points, places.reshape(-1, 3)

    @cached_property
    def around(self) -> Any:
        """Sparse (p, t): the triangles of every point."""
        from scipy import sparse

        count = len(self.triangles)
        rows, columns = self.triangles.ravel(), np.repeat(np.arange(count), 3)
        return sparse.csr_array((np.ones(rows.size, np.int8), (rows, columns)), shape=(len(self.points), count))

    @cached_property
    def border(self) -> BoolArray:
        """(p,) points at the border of an open surface."""
        return np.isin(np.arange(len(self.points)), border_points(len(self.points), self.triangles))


class Touching(NamedTuple):
    """Points that lie in something."""

    rows: IntArray  # (m,) into the points that were asked for
    depths: FloatArray  # (m,) above 0
    out: FloatArray  # (m, 3) unit, the way out
    leaders: IntArray  # (m,) points that make way the other way; -1 for what does not


class LooseParts(NamedTuple):
    """Parts that keep their shape."""

    points: IntArray  # (p,) into all points
    part: IntArray  # (p,) number of the part


class Surface:
    """A body in one pose of one face.

    :param pose: (n, 3) all points
    :param centre: (3,) of an eyeball
    """

    def __init__(self, body: Body, pose: FloatArray, centre: FloatArray | None, mm_per_unit: float) -> None:
        from scipy.spatial import cKDTree

        self.body, self._deepest, self._points = body, _DEEPEST_MM / mm_per_unit, pose[body.points]
        self._pose, self._off = pose, _OFF_MM / mm_per_unit
        self.ball = None if centre is None else RadialSurface(self._points, centre)
        if self.ball is None:
            self._normals = point_normals(self._points, body.triangles)
            self._tree: Any = cKDTree(self._points)
            ends = body.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            sides = self._points.take(ends[:, 1], axis=0) - self._points.take(ends[:, 0], axis=0)
            lengths = np.sqrt(np.einsum("ei,ei->e", sides, sides))
            self._spacing = np.zeros(len(self._points))
            np.maximum.at(self._spacing, ends[:, 0], lengths)

    def touching(self, points: FloatArray, normals: FloatArray | None = None) -> Touching:
        """Those of `points` (m, 3) that lie in the body.

        :param normals: (m, 3) of the skin there, for lips
        """
        if self.ball is not None:
            depths = self.ball.depths(points)
            rows = np.flatnonzero(depths > 0)
            out = points[rows] - self.ball.centre
            out /= np.maximum(np.linalg.norm(out, axis=1), np.finfo(np.float64).tiny)[:, None]
            return Touching(rows, depths[rows], out, np.full(len(rows), -1))
        far, nearest = self._tree.query(points, distance_upper_bound=self._deepest)
        rows = np.flatnonzero(np.isfinite(far))
        beyond = np.einsum("mi,mi->m", points[rows] - self._points[nearest[rows]], self._normals[nearest[rows]])
        # exact places take long, and of skin near the other lip six points in seven are clearly outside
        rows = rows[beyond < np.minimum(self._spacing[nearest[rows]], _STEEP * far[rows])]
        depths, ways, beside = self._depths(points[rows])
        # a lip goes on beyond its border, where lips are joined: whether there is flesh, winding numbers say
        inside = depths > self._off if self.body.soft else (depths > 0) & ~beside
        if normals is not None:
            inside &= np.einsum("mi,mi->m", ways, normals[rows]) < 0  # lips face each other
            inside[inside] = self._in_flesh(points[rows[inside]], normals[rows[inside]])
        rows = rows[inside]
        leaders = self.body.points[nearest[rows]] if self.body.soft else np.full(len(rows), -1)
        return Touching(rows, depths[inside], ways[inside], leaders)

    def depths(self, points: FloatArray, normals: FloatArray | None = None) -> FloatArray:
        """(m,) how deep `points` (m, 3) lie in the body, behind it or its border: it is what is let through."""
        if self.ball is not None:
            return self.ball.depths(points)
        depths = self._depths(points)[0].clip(0.0)
        if normals is not None:
            rows = np.flatnonzero(depths)
            depths[rows] *= self._in_flesh(points[rows], normals[rows])
        return depths

    def _in_flesh(self, points: FloatArray, normals: FloatArray) -> BoolArray:
        """(m,) whether skin at `points` (m, 3) lies inside the face, not on its outside.

        At corners of mouths lips are folds of less than a millimetre: of places 0.3 mm or more below the nearest one of
        the other lip, by its normal, 7 of 8 are in the open.
        """
        return np.asarray(self._flesh.at(points + self._off * normals) > _INSIDE)

    @cached_property
    def _flesh(self) -> WindingNumbers:
        points, triangles = self.body.flesh_surface
        return WindingNumbers(self._pose.take(points, axis=0), triangles)

    def _depths(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(m,) how deep `points` (m, 3) lie below the nearest place of the surface, (m, 3) the way out there, and
        whether (m,) it is on the border of an open surface, beside which nothing is inside what is hard.

        By the planes at its nearest points alone, a tooth's edge let lips 0.8 mm deeper than in any source.
        """
        from scipy.sparse import csr_array

        body = self.body
        if not len(points):
            return np.zeros(0), np.zeros((0, 3)), np.zeros(0, bool)
        _, near = self._tree.query(points, k=np.arange(1, min(_NEAREST, len(self._points)) + 1))
        # each triangle once, though several of its corners may be near
        chosen = csr_array(
            (np.ones(near.size, np.int8), near.ravel(), np.arange(len(near) + 1) * near.shape[1]),
            shape=(len(near), len(self._points)),
        )
        pairs = (chosen @ body.around).tocoo()
        owners, candidates = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
        places = closest_among(points, self._points, body.triangles, owners, candidates)
        corners, shares = body.triangles[places.triangles], place_shares(places, self._points, body.triangles)
        out = unit_vectors(np.einsum("mk,mki->mi", shares, self._normals[corners]))
        far = np.where(np.isfinite(places.distances), places.distances, 0.0)  # a lip's last points have no triangle
        depths: FloatArray = -np.sign(np.einsum("mi,mi->m", points - places.places, out)) * far
        return depths, out, (body.border[corners] | (shares == 0)).all(axis=1)


class Stand:
    """One face, a source or the blend, at rest: its points (n, 3) and the surfaces of all bodies."""

    def __init__(self, bodies: Sequence[Body], points: FloatArray, mm_per_unit: float) -> None:
        self._points, self._mm_per_unit = points, mm_per_unit
        self._rest = {body: Surface(body, points, _centre(body, points), mm_per_unit) for body in bodies}

    def surface(self, body: Body, pose: FloatArray, moving: BoolArray) -> Surface:
        """A body in a pose (n, 3) of the face in which some points (n,) move."""
        rest = self._rest[body]
        if not moving[body.flesh_surface[0] if body.soft else body.points].any():
            return rest
        centre = None
        if body.ball is not None and rest.ball is not None:
            motion = fit_similarity(self._points[body.ball], pose[body.ball])
            centre = motion.apply(rest.ball.centre[None])[0]
        return Surface(body, pose, centre, self._mm_per_unit)


def _centre(body: Body, points: FloatArray) -> FloatArray | None:
    """Of an eyeball."""
    if body.ball is None:
        return None
    shell = points[body.points]
    try:
        return fit_ball(shell, point_areas(shell, body.triangles)).centre  # a cornea is modelled more densely
    except FitError:
        return np.asarray(shell.mean(axis=0))


def find_bodies(sources: Sources, graph: Graph, loose: LooseParts) -> tuple[Body, ...]:
    """All that skin may touch."""
    mouth = _mouth(sources, graph)
    return (*_eyeballs(sources, graph, loose), *_solids(sources, graph, mouth), *_lips(sources, graph, mouth))


def _eyes(sources: Sources, loose: LooseParts) -> Iterator[tuple[str, IntArray]]:
    """Names and all points of parts that may be eyeballs: those in meshes named like an eye."""
    offsets = sources.mesh_offsets
    for mesh, start, end in zip(sources.base.meshes, offsets[:-1], offsets[1:], strict=True):
        inside = (loose.points >= start) & (loose.points < end)
        parts = np.unique(loose.part[inside])
        for count, part in enumerate(parts if "eye" in mesh.name.lower() else (), 1):
            yield mesh.name if len(parts) == 1 else f"{mesh.name} {count}", loose.points[loose.part == part]


def _eyeballs(sources: Sources, graph: Graph, loose: LooseParts) -> Iterator[Body]:
    """Every kept part that is round and belongs to a mesh named like an eye."""
    face = np.flatnonzero(graph.main)
    for name, part in _eyes(sources, loose):
        shell, triangles = _outer_shell(part, sources.points[0], graph)
        around, known = np.zeros(len(face), bool), True
        for points in sources.points:
            try:
                ball = fit_ball(points[shell], point_areas(points[shell], triangles))
            except FitError:
                known = False
                break
            known &= ball.rms <= _ROUND * ball.radius
            around |= np.linalg.norm(points[face] - ball.centre, axis=1) < _AROUND * ball.radius
        if known and around.any():
            yield Body(name, shell, triangles, face[around], ball=part)


class _Mouth(NamedTuple):
    """Skin near the opening of the mouth, the only skin there that may be seen."""

    skin: IntArray  # (s,)
    side: IntArray  # (s,) 1 of the upper lip, -1 of the lower, 0 where they are joined


def _mouth(sources: Sources, graph: Graph) -> _Mouth | None:
    """By the way along the skin from the landmarks of the outer lips; None without these."""
    base = sources.points[0]
    for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True):
        marks = mesh.landmarks.get(LANDMARK_SCHEME)
        if marks is None or len(marks.indices) != LANDMARK_COUNT:
            continue
        numbers = np.asarray(marks.indices, np.int64) + start
        corners = base[numbers[_CORNERS]]
        close = np.linalg.norm(base - corners.mean(axis=0), axis=1) < np.linalg.norm(corners[1] - corners[0])
        skin = np.flatnonzero(close & graph.main)
        place = np.full(len(base), -1)
        place[skin] = np.arange(len(skin))
        if (place[numbers[[*_UPPER, *_LOWER]]] < 0).any():
            return None
        own = _inside(skin, graph.triangles, len(base))
        ways = surface_graph(base[skin], np.pad(own, ((0, 0), (0, 1)), constant_values=-1))
        away = graph_distances(ways, [place[numbers[_UPPER]], place[numbers[_LOWER]]]) * sources.mm_per_unit
        near = away.min(axis=0) < _LIPS_MM
        upper, lower = away[:, near]
        side = np.where(upper + _JOINED_MM < lower, 1, np.where(lower + _JOINED_MM < upper, -1, 0))
        return _Mouth(skin[near], side)
    return None


def _solids(sources: Sources, graph: Graph, mouth: _Mouth | None) -> Iterator[Body]:
    """Teeth and gums, all of a mesh at once."""
    from scipy.spatial import cKDTree

    face, base = np.flatnonzero(graph.main) if mouth is None else mouth.skin, sources.points[0]
    for mesh, start, end in zip(sources.base.meshes, sources.mesh_offsets[:-1], sources.mesh_offsets[1:], strict=True):
        points = np.flatnonzero(~graph.main[start:end]) + start
        if not len(points) or not any(word in mesh.name.lower() for word in _HARD):
            continue
        triangles = _inside(points, graph.triangles, len(base))
        far, _ = cKDTree(base[points]).query(base[face], distance_upper_bound=_NEAR_MM / sources.mm_per_unit)
        if len(triangles) and np.isfinite(far).any():
            yield Body(mesh.name, points, triangles, face[np.isfinite(far)])


def _lips(sources: Sources, graph: Graph, mouth: _Mouth | None) -> Iterator[Body]:
    """Each lip as what the other may touch."""
    if mouth is None:
        return
    count = len(graph.component)
    lips = [mouth.skin[mouth.side == side] for side in (-1, 1)]
    flesh = _gathered(graph.triangles[graph.main[graph.triangles[:, 0]]], sources, np.concatenate(lips))
    for name, points, other in zip(("lower lip", "upper lip"), lips, lips[::-1], strict=True):
        if len(points) and len(other):
            triangles, facing = (_inside(one, graph.triangles, count) for one in (points, other))
            yield Body(name, points, triangles, other, facing=facing, flesh=flesh)


def _gathered(triangles: IntArray, sources: Sources, skin: IntArray) -> IntArray:
    """(t, 3) triangles whose points far from the skin are gathered, those of a cell at one of them.

    Winding numbers near the skin stay, as no cell reaches there: only open borders, far away, move a little. A head's
    28,000 triangles become 6,000.
    """
    from scipy.spatial import cKDTree

    used, points = np.unique(triangles), sources.points[0] * sources.mm_per_unit
    away, _ = cKDTree(points[skin]).query(points[used])
    far = used[away >= _FLESH_MM]
    begins = _FLESH_MM * 2.0 ** np.floor(np.log2(away[away >= _FLESH_MM] / _FLESH_MM))[:, None]
    cells = np.concatenate([begins, np.floor(points[far] / (_CELL * begins))], axis=1)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    place = np.arange(len(points))
    place[far] = far[first][cell.ravel()]
    gathered = place[triangles]
    return np.asarray(gathered[(gathered != np.roll(gathered, 1, axis=1)).all(axis=1)])


def _outer_shell(part: IntArray, points: FloatArray, graph: Graph) -> tuple[IntArray, IntArray]:
    """Points (s,) and triangles (t, 3), into them, of the outermost of a part's large components.

    Eyeballs are modelled as one shell around another; small components are irises, lenses and caps.
    """
    inside = np.zeros(len(points), bool)
    inside[part] = True
    triangles = graph.triangles[inside[graph.triangles[:, 0]]]
    component = graph.component[part]
    areas = np.bincount(component, point_areas(points, triangles)[part])
    reach = np.zeros(len(areas))
    np.maximum.at(reach, component, np.linalg.norm(points[part] - points[part].mean(axis=0), axis=1))
    shell = part[component == np.where(areas >= _LARGE * areas.max(), reach, 0.0).argmax()]
    return shell, _inside(shell, triangles, len(points))


def _inside(points: IntArray, triangles: IntArray, count: int) -> IntArray:
    """(t, 3) those of `triangles` whose corners are all among `points`, as places in these."""
    place = np.full(count, -1)
    place[points] = np.arange(len(points))
    placed = place[triangles]
    return np.asarray(placed[(placed >= 0).all(axis=1)])
