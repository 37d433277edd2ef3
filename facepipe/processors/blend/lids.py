"""How deep lids cut into eyeballs, in a blend and in its sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.errors import FitError
from facepipe.geometry.balls import Ball, fit_ball
from facepipe.geometry.polygons import point_areas, point_triangles
from facepipe.processors.blend.session import BlendSession, Solution

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_ROUND = 0.1  # RMS distance from a ball, in radii, up to which a part counts as an eyeball


@dataclass(frozen=True, kw_only=True)
class LidContact:
    """Points of the face inside one eyeball, a ball fitted to it, by the depth of the deepest."""

    depth_mm: float
    sources_mm: tuple[float, ...]  # the same in every source
    worst_shape: str | None = None  # at weight 1, the one that goes deepest beyond what it does in the sources
    worst_depth_mm: float = 0.0
    worst_sources_mm: tuple[float, ...] = ()


def lid_contacts(session: BlendSession, solution: Solution) -> dict[str, LidContact]:
    """The contact at every kept mesh that is round and named like an eye."""
    sources = session.sources
    found = {}
    for number, mesh in enumerate(sources.base.meshes):
        own = np.arange(*sources.mesh_offsets[number : number + 2])
        if "eye" not in mesh.name.lower() or not np.isin(own, session.kept.points).all():
            continue
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        balls = [_ball(points[own], triangles) for points in (*sources.points, solution.neutral.points)]
        if all(ball is not None for ball in balls):
            found[mesh.name] = _contact(session, solution, [ball for ball in balls if ball is not None], own)
    return found


def _ball(points: FloatArray, triangles: IntArray) -> Ball | None:
    try:
        ball = fit_ball(points, point_areas(points, triangles))  # a cornea is modelled more densely
    except FitError:
        return None
    return ball if ball.rms <= _ROUND * ball.radius else None


def _contact(session: BlendSession, solution: Solution, balls: list[Ball], own: IntArray) -> LidContact:
    sources, neutral, mm = session.sources, solution.neutral, session.sources.mm_per_unit
    face = np.flatnonzero(session.network.main)
    stands = [*sources.points, neutral.points]
    still = [_depths(points[face], ball) * mm for points, ball in zip(stands, balls, strict=True)]
    worst: tuple[float, str | None, list[float]] = (-np.inf, None, [0.0] * len(balls))
    for number, sculpt in enumerate(solution.sculpts):
        if np.isin(sculpt.points, own).any():  # a moving eyeball takes its ball along
            continue
        place = np.searchsorted(face, sculpt.points)
        inside = np.isin(sculpt.points, face)
        depths = []
        for k, (points, ball) in enumerate(zip(stands, balls, strict=True)):
            offsets = sculpt.offsets[k] if k < len(sources.points) else solution.offsets[number]
            moved = still[k].copy()
            moved[place[inside]] = _depths((points[sculpt.points] + offsets)[inside], ball) * mm
            depths.append(float(moved.max(initial=0.0)))
        beyond = depths[-1] - max(depths[:-1])
        if beyond > worst[0]:
            worst = (beyond, sculpt.name, depths)
    rest = [float(max(depths.max(initial=0.0), 0.0)) for depths in still]
    return LidContact(
        depth_mm=rest[-1],
        sources_mm=tuple(rest[:-1]),
        worst_shape=worst[1],
        worst_depth_mm=worst[2][-1],
        worst_sources_mm=tuple(worst[2][:-1]),
    )


def _depths(points: FloatArray, ball: Ball) -> FloatArray:
    return np.asarray(ball.radius - np.linalg.norm(points - ball.centre, axis=1))
