"""Loose parts that are eyeballs, and what lies in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.balls import fit_ball
from facepipe.geometry.polygons import point_areas
from facepipe.processors.skin.surface import Surface

_SMALLEST, _LARGEST = 6.0, 25.0  # mm, radius
_ROUND = 0.12  # largest rms distance from the ball, of its radius
_WHOLE = 0.75  # a ball's points reach at least this far around: (farthest apart / diameter)
_FEWEST = 20  # points
_INSIDE = 1.25  # other parts of the same mesh up to so many radii from the centre go with the ball


@dataclass(frozen=True, kw_only=True)
class Eyeball:
    """A ball-shaped loose part, in millimetres."""

    centre: FloatArray  # (3,)
    radius: float
    points: IntArray  # its points, and those of parts of the same mesh in it


def eyeballs_of(surface: Surface) -> tuple[Eyeball, ...]:
    """The eyeballs of a face, by their first points."""
    areas = point_areas(surface.points, surface.triangles)
    found: list[Eyeball] = []
    for number in np.unique(surface.component[surface.loose]):
        points = np.flatnonzero(surface.component == number)
        ball = _ball(surface.points[points], areas[points])
        if ball is not None and not any(np.isin(points[0], one.points) for one in found):
            found.append(Eyeball(centre=ball[0], radius=ball[1], points=_with_contents(surface, points, *ball)))
    return tuple(found)


def _ball(points: FloatArray, areas: FloatArray) -> tuple[FloatArray, float] | None:
    if len(points) < _FEWEST or not areas.any():
        return None
    try:
        ball = fit_ball(points, areas)
    except FitError:
        return None
    whole = np.ptp(points, axis=0).min() >= _WHOLE * 2.0 * ball.radius
    if whole and _SMALLEST <= ball.radius <= _LARGEST and ball.rms <= _ROUND * ball.radius:
        return ball.centre, ball.radius
    return None


def _with_contents(surface: Surface, points: IntArray, centre: FloatArray, radius: float) -> IntArray:
    near = np.linalg.norm(surface.points - centre, axis=1) <= _INSIDE * radius
    same = (surface.mesh == surface.mesh[points[0]]) & (surface.component != surface.main)
    outside = np.unique(surface.component[same & ~near])
    contents = same & near & ~np.isin(surface.component, outside)
    return np.flatnonzero(contents | (surface.component == surface.component[points[0]]))
