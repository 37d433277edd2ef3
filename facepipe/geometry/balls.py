"""Eyeballs: the ball that fits points whatever the cornea does, and surfaces by their radius in every direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError

_MOST_STEPS = 100
_SETTLED_STEP = 1e-12  # of the radius
_TUKEY_REACH = 4.685  # Tukey's constant: 95% efficient on normal residuals
_MEDIAN_TO_DEVIATION = 1.4826  # median absolute residual -> standard deviation
_EXACT_RESIDUAL = 1e-9  # residuals below this share of the radius are rounding, none of them an outlier
_PLANE_THICKNESS = 1e-6  # points thinner than this share of their spread are a plane
_POINTS_MIXED = 3  # points nearest in direction
_LEAST_ANGLE = 1e-6  # angles below this count as this: at a point itself its own radius is all that counts


@dataclass(frozen=True)
class Ball:
    """A ball through points."""

    centre: FloatArray  # (3,)
    radius: float
    rms: float  # weighted, of the distances of all points from the surface


def fit_ball(points: FloatArray, weights: FloatArray | None = None) -> Ball:
    """The ball whose surface is nearest to `points` (n, 3), n at least 4; points that bulge out of it count little.

    An algebraic fit, made geometric by Gauss-Newton steps with Tukey's weights against the median of the residuals: as
    long as the bulge (a cornea) has less than about a third of the weight, the ball is that of the others.

    :param weights: (n,), 0 or more, not all 0. `polygons.point_areas` keeps dense parts of a mesh, as eyeballs have at
        the cornea, from counting for more than they are
    :raises FitError: fewer than 4 points of weight, or points in one plane
    """
    points = np.asarray(points, np.float64)
    shares = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    points, shares = points[shares > 0], shares[shares > 0]
    if len(points) < 4 or not np.isfinite(points).all():
        raise FitError("ball", f"{len(points)} points, expected at least 4, all finite")
    shares = shares / shares.sum()
    middle = shares @ points
    # the algebraic fit squares coordinates: 1e6 from the origin, a ball of radius 12 would come out 7e-5 too small
    local = points - middle
    spread = np.linalg.svd(local, compute_uv=False)
    if not spread[2] > _PLANE_THICKNESS * spread[0]:
        raise FitError("ball", "all points lie in one plane, expected points around it")
    # least squares of ``|p|^2 = 2 c.p + (r^2 - c.c)``: weighs residuals by about twice the radius, and is drawn in by
    # points that lie inside
    root, ones = np.sqrt(shares), np.ones(len(local))
    system = np.column_stack([2.0 * local, ones])
    found = np.linalg.lstsq(system * root[:, None], (local**2).sum(axis=1) * root, rcond=None)[0]
    centre = found[:3]
    radius = float(np.sqrt(max(found[3] + centre @ centre, 0.0)))
    # then Gauss-Newton steps on ``sum w t (|p - c| - r)^2`` with shares w and Tukey's weights
    # ``t = (1 - (residual / reach)^2)^2``. An eye of 12 mm, 6 % of it cornea: the centre is 0.15 mm off by the
    # algebraic fit, 0.14 by plain steps, exact by these
    for _ in range(_MOST_STEPS):
        offsets = local - centre
        distances = np.linalg.norm(offsets, axis=1)
        residuals = distances - radius
        order = np.argsort(np.abs(residuals), kind="stable")
        median = abs(float(residuals[order[np.searchsorted(np.cumsum(shares[order]), 0.5 - 1e-12)]]))
        reach = _TUKEY_REACH * max(_MEDIAN_TO_DEVIATION * median, _EXACT_RESIDUAL * radius)
        trusted = root * np.maximum(1.0 - (residuals / reach) ** 2, 0.0)
        slopes = np.column_stack([-offsets / np.maximum(distances, radius * 1e-12)[:, None], -ones])
        step = np.linalg.lstsq(slopes * trusted[:, None], -residuals * trusted, rcond=None)[0]
        centre, radius = centre + step[:3], radius + float(step[3])
        if np.abs(step).max() <= _SETTLED_STEP * radius:
            break
    residuals = np.linalg.norm(local - centre, axis=1) - radius
    return Ball(centre + middle, radius, float(np.sqrt(shares @ residuals**2)))


class RadialSurface:
    """A surface that every ray from its centre crosses once.

    Its radius in a direction is ``sum r_i / a_i^2 / sum 1 / a_i^2`` over the points that are nearest in direction, a_i
    the length between the unit directions (about the angle). So a ball is exact however coarse its mesh is, and a
    surface that ends (the front half of an eye) goes on as a ball.

    :param points: (n, 3) of the surface, n at least 1
    :param centre: (3,)
    """

    def __init__(self, points: FloatArray, centre: FloatArray) -> None:
        from scipy.spatial import cKDTree

        self.centre = np.asarray(centre, np.float64)
        directions, self._radii = self._polar(points)
        self.largest = float(self._radii.max())
        self._tree = cKDTree(directions)

    def depths(self, points: FloatArray) -> FloatArray:
        """(m,) how far `points` (m, 3) lie inside, along the ray from the centre; 0 outside."""
        directions, distances = self._polar(points)
        near = np.flatnonzero(distances < self.largest)
        angles, which = self._tree.query(directions[near], k=np.arange(1, min(_POINTS_MIXED, len(self._radii)) + 1))
        weights = 1.0 / np.maximum(angles, _LEAST_ANGLE) ** 2
        radii = (weights * self._radii[which]).sum(axis=1) / weights.sum(axis=1)
        depths = np.zeros(len(distances))
        depths[near] = np.maximum(radii - distances[near], 0.0)
        return depths

    def _polar(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        offsets = np.asarray(points, np.float64) - self.centre
        lengths = np.sqrt(np.einsum("mi,mi->m", offsets, offsets))
        return offsets / np.where(lengths > 0, lengths, 1.0)[:, None], lengths
