"""Lips, lids and eyeballs: which side of the mouth and of either eye a point is on, and which parts are balls.

The inner lip and lid landmarks draw a row along either rim of a slit. Distances along the surface from the two rows say
on which side a point is: the rims may touch, but over the surface one leads to the other round a corner only, or
through the inside of the mouth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import FitError
from facepipe.geometry.balls import fit_ball
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.polygons import point_areas
from facepipe.verbs.skin.surface import Surface

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
    return tuple(_slit(surface, surface.landmarks, name) for name in _RIMS)


def _slit(surface: Surface, landmarks: IntArray, name: str) -> Slit:
    upper, lower, corners = _RIMS[name]
    rows = [points_between(surface, landmarks[list(rim)]) for rim in (upper, lower)]
    above, below = graph_distances(surface.graph, rows)
    width = float(np.linalg.norm(np.subtract(*surface.points[landmarks[list(corners)]])))
    reached = np.isfinite(above) & np.isfinite(below)
    side = np.zeros(len(surface.points))
    side[reached] = np.clip((below[reached] - above[reached]) / max(width, np.finfo(np.float64).tiny), -1.0, 1.0)
    return Slit(name=name, width=width, side=side, distance=np.minimum(above, below))


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
        ball = _ball(surface.points[points], areas[points])
        if ball is not None and not any(np.isin(points[0], eyeball.points) for eyeball in eyeballs):
            eyeballs.append(Eyeball(centre=ball[0], radius=ball[1], points=_with_contents(surface, points, *ball)))
    return tuple(eyeballs)


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
