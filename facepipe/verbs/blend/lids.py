"""How deep the skin around the eyes cuts into the eyeballs, in a blend and in its sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.balls import RadialSurface, fit_ball
from facepipe.geometry.polygons import point_areas
from facepipe.geometry.similarity import fit_similarity
from facepipe.verbs.blend.session import BlendSession, Solution

_ROUND = 0.1  # RMS distance from a ball, in radii, up to which a part counts as an eyeball
_LARGE = 0.5  # area of a component, relative to the largest of its part, from which on it may be the outer shell
_AROUND = 2.0  # radii from an eyeball's centre within which the face is looked at


@dataclass(frozen=True, kw_only=True)
class LidContact:
    """Depths of points of the face in one eyeball (0 outside), each beside that of the same point in every source.

    Sockets reach into the eyeballs of many faces as they come: what counts is the point that goes furthest beyond the
    deepest that it does in a source. Where none goes beyond, it is the deepest.
    """

    depth_mm: float  # at rest
    sources_mm: tuple[float, ...]
    worst_shape: str | None = (
        None  # at weight 1, the one that goes furthest beyond, where one goes further than at rest
    )
    worst_depth_mm: float = 0.0
    worst_sources_mm: tuple[float, ...] = ()


def lid_contacts(session: BlendSession, solution: Solution) -> dict[str, LidContact]:
    """The contact at every kept part that is round and belongs to a mesh named like an eye."""
    contacts = {}
    for name, part in _eye_parts(session):
        shell = _outer_shell(session, part)
        stands = [_surface(points, shell) for points in (*session.sources.points, solution.neutral.points)]
        surfaces = [surface for surface in stands if surface is not None]
        if len(surfaces) == len(stands):
            contacts[name] = _Eye(session, solution, part, surfaces).contact()
    return contacts


def _eye_parts(session: BlendSession) -> Iterator[tuple[str, IntArray]]:
    """Name and points of the kept parts of meshes named like an eye, numbered where a mesh has several."""
    kept, offsets = session.kept, session.sources.mesh_offsets
    for number, mesh in enumerate(session.sources.base.meshes):
        inside = (kept.points >= offsets[number]) & (kept.points < offsets[number + 1])
        if "eye" not in mesh.name.lower():
            continue
        parts = np.unique(kept.part[inside])
        for count, part in enumerate(parts, 1):
            yield mesh.name if len(parts) == 1 else f"{mesh.name} {count}", kept.points[kept.part == part]


def _outer_shell(session: BlendSession, part: IntArray) -> tuple[IntArray, IntArray]:
    """Points (s,) and triangles (t, 3), into them, of the outermost of a part's large components.

    Eyeballs are modelled as one shell around another; small components are irises, lenses and caps.
    """
    graph, points = session.graph, session.sources.points[0]
    triangles = graph.triangles[_places(part, len(points))[graph.triangles[:, 0]] >= 0]
    component = graph.component[part]
    areas = np.bincount(component, point_areas(points, triangles)[part])
    reach = np.zeros(len(areas))
    np.maximum.at(reach, component, np.linalg.norm(points[part] - points[part].mean(axis=0), axis=1))
    shell = part[component == np.where(areas >= _LARGE * areas.max(), reach, 0.0).argmax()]
    local = _places(shell, len(points))[triangles]
    return shell, local[local[:, 0] >= 0]


def _surface(points: FloatArray, shell: tuple[IntArray, IntArray]) -> RadialSurface | None:
    shell_points = points[shell[0]]
    try:
        ball = fit_ball(shell_points, point_areas(shell_points, shell[1]))  # a cornea is modelled more densely
    except FitError:
        return None
    return RadialSurface(shell_points, ball.centre) if ball.rms <= _ROUND * ball.radius else None


class _Eye:
    """One eyeball and the face around it, in the sources and, last, in the blend."""

    def __init__(
        self, session: BlendSession, solution: Solution, part: IntArray, surfaces: list[RadialSurface]
    ) -> None:
        self._solution, self._surfaces, self._mm = solution, surfaces, session.sources.mm_per_unit
        stands = (*session.sources.points, solution.neutral.points)
        face = np.flatnonzero(session.graph.main)
        around = [
            ((points[face] - surface.centre) ** 2).sum(axis=1) < (_AROUND * surface.largest) ** 2
            for points, surface in zip(stands, surfaces, strict=True)
        ]
        face = face[np.any(around, axis=0)]
        self._face = [points[face] for points in stands]
        self._part = [points[part] for points in stands]
        self._on_face, self._on_part = (_places(own, len(stands[0])) for own in (face, part))

    def contact(self) -> LidContact:
        """The depths at rest and in the worst shape."""
        if not len(self._face[0]):
            return LidContact(depth_mm=0.0, sources_mm=(0.0,) * (len(self._face) - 1))
        rest = [surface.depths(points) for surface, points in zip(self._surfaces, self._face, strict=True)]
        beyond, (*sources, depth) = self._furthest(rest)
        shape, worst = None, [0.0] * len(rest)
        for number, sculpt in enumerate(self._solution.sculpts):
            further, depths = self._furthest(self._posed(number, rest))
            if further > max(beyond, 0.0):
                beyond, shape, worst = further, sculpt.name, depths
        return LidContact(
            depth_mm=depth,
            sources_mm=tuple(sources),
            worst_shape=shape,
            worst_depth_mm=worst[-1],
            worst_sources_mm=() if shape is None else tuple(worst[:-1]),
        )

    def _furthest(self, depths: list[FloatArray]) -> tuple[float, list[float]]:
        """How far beyond the sources a point goes at most, and its depths in all, mm."""
        beyond = depths[-1] - np.max(depths[:-1], axis=0)
        point = beyond.argmax() if beyond.max() > 0 else depths[-1].argmax()
        return float(beyond[point]) * self._mm, [float(depth[point]) * self._mm for depth in depths]

    def _posed(self, number: int, rest: list[FloatArray]) -> list[FloatArray]:
        """Depths of the face around the eye under one sculpt, in every source and in the blend."""
        sculpt = self._solution.sculpts[number]
        on_face, on_part = self._on_face[sculpt.points], self._on_part[sculpt.points]
        skin, eye = on_face >= 0, on_part >= 0
        posed = list(rest)
        for k, offsets in enumerate((*sculpt.offsets, self._solution.offsets[number])):
            if eye.any():
                posed[k] = self._turned(k, (on_face[skin], offsets[skin]), (on_part[eye], offsets[eye]))
            elif skin.any():
                posed[k] = rest[k].copy()
                moved = self._face[k][on_face[skin]] + offsets[skin]
                posed[k][on_face[skin]] = self._surfaces[k].depths(moved)
        return posed

    def _turned(self, k: int, skin: tuple[IntArray, FloatArray], eye: tuple[IntArray, FloatArray]) -> FloatArray:
        """Depths where the eyeball moves too: the face is seen from the eyeball."""
        face, part = self._face[k].copy(), self._part[k].copy()
        face[skin[0]] += skin[1]
        part[eye[0]] += eye[1]
        motion = fit_similarity(self._part[k], part)
        return motion.scale * self._surfaces[k].depths(motion.undo(face))


def _places(points: IntArray, count: int) -> IntArray:
    """(count,) place of every point in `points`; -1 where it is not there."""
    places = np.full(count, -1)
    places[points] = np.arange(len(points))
    return places
