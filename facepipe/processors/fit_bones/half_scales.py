"""Poses whose scales SkelAnimation, which keeps them in half precision, holds as they are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.threads import one_thread
from facepipe.processors.fit_bones.session import BoneFit
from facepipe.rig import Rig, rest_coefficients
from facepipe.rig.trs import decompose

_DAMPING = 1e-4  # of the normal matrix with a diagonal of 1: what points hardly hold keeps its place
_FLAT = 1e-9  # of the largest diagonal element: unknowns that move points less count as if they did that
_SAME = 2e-7  # relative: a scale that is as near to one in half precision is it


class HalfScales:
    """Brings the scales of poses to half precision, for the points that count in one session.

    Scales are rounded one after another, the one that moves the points most first, and what a rounding does, the scales
    left, the translations and the rotations make good: the normal matrix at the pose tells how (Babai, "On Lovász'
    lattice reduction and the nearest lattice point problem", Combinatorica 1986).

    """

    def __init__(self, session: BoneFit) -> None:
        self._session = session
        self._pairs = session.skin.moments(session.rig.points, session.weights, session.tree.parent_world).pairs
        numbers = np.arange(len(session.variables)) + 1.0
        places = np.abs(session.variables.expanded(numbers, np.zeros(session.lower.shape))).astype(np.int64).ravel()
        unknowns, first = np.unique(places, return_index=True)
        self._places = first[unknowns > 0]  # (v,) a coefficient, of 9m, that is each unknown

    def near(self, coefficients: FloatArray, target: FloatArray) -> FloatArray:
        """(m, 9) float32 numbers near (m, 9) `coefficients`: local transforms whose scales are half precision.

        Where limits leave no such scale beside a coefficient, and where a transform has shear, it stays as it is.

        :param target: (n, 3) of which few points are to be further off than the session's threshold
        """
        rounded = self._rounded(coefficients)
        with one_thread():
            made_good = self._rounded(self._made_good(coefficients, rounded))
        return made_good if self._off(made_good, target) <= self._off(rounded, target) else rounded

    def _off(self, coefficients: FloatArray, target: FloatArray) -> int:
        session = self._session
        apart = np.linalg.norm(session.rig.evaluate(coefficients=coefficients) - target, axis=1)
        return int(((apart > session.threshold) & (session.weights > 0)).sum())

    def _rounded(self, coefficients: FloatArray) -> FloatArray:
        """(m, 9) with each scale by itself brought to half precision, tied ones alike."""
        session = self._session
        found = with_half_scales(session.rig, coefficients, session.lower, session.upper)
        if session.symmetry is not None:
            found[:, 6:] = found.ravel()[session.symmetry.leaders].reshape(found.shape)[:, 6:]
        return found.astype(np.float32).astype(np.float64)

    def _made_good(self, coefficients: FloatArray, rounded: FloatArray) -> FloatArray:
        """(m, 9) near `coefficients`, with scales of half precision; what is not unknown as in `rounded`."""
        variables = self._session.variables
        x, factors = variables.reduced(coefficients), np.full(coefficients.shape, np.nan)
        factors[:, 6:] = _factors(self._session.rig, coefficients)
        own = factors.ravel()[self._places]  # NaN of unknowns that are no scales
        moving = np.flatnonzero(self._may_move(x, ~np.isnan(own)))
        hessian, sizes = self._normal(coefficients, moving)
        order = np.argsort(-sizes, kind="stable")
        order = order[~np.isnan(own[moving[order]])]
        if not len(order):
            return rounded
        columns = np.linalg.solve(hessian, np.eye(len(moving))[:, order])  # of the inverse
        left = np.linalg.cholesky(columns[order]).T
        scales, size = moving[order], sizes[order]
        values = x[scales].copy()
        for number, scale in enumerate(scales):
            low, high = variables.lower[scale], variables.upper[scale]
            wanted = float(_nearest(np.clip(values[number], low, high), own[scale], low, high))
            error = (wanted - values[number]) * size[number] / left[number, number]
            values[number:] += error * left[number, number:] / size[number:]
        x[moving] += columns @ np.linalg.solve(columns[order], (values - x[scales]) * size) / sizes
        x[scales] = values
        return variables.expanded(np.clip(x, variables.lower, variables.upper), rounded)

    def _may_move(self, x: FloatArray, scales: BoolArray) -> BoolArray:
        """(v,) unknowns no limit holds, or scales; in a sparse fit none that rests."""
        session = self._session
        inside = scales | ((session.variables.lower < x) & (x < session.variables.upper))
        rest = session.variables.reduced(rest_coefficients(len(session.rig.joints)))
        return np.asarray(inside & (x != rest) if session.sparsity > 0 else inside)

    def _normal(self, coefficients: FloatArray, moving: npt.NDArray[np.integer]) -> tuple[FloatArray, FloatArray]:
        """Damped normal matrix (k, k) of the `moving` unknowns in units of how far each moves the points, (k,)."""
        tree, variables = self._session.tree, self._session.variables
        pose = tree.pose(coefficients)
        own = tree.normal_matrix(tree.generators(pose), pose, self._pairs, variables.joints)
        own = variables.matrix(own)[np.ix_(moving, moving)]
        diagonal = np.diag(own)
        sizes = np.sqrt(np.maximum(diagonal, max(_FLAT * diagonal.max(initial=0.0), np.finfo(np.float64).tiny)))
        return own / np.outer(sizes, sizes) + _DAMPING * np.eye(len(own)), sizes


def with_half_scales(rig: Rig, coefficients: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """(m, 9) `coefficients` with each scale the nearest that makes that of the local transform half precision.

    Where limits (m, 9) leave no such scale beside a coefficient, and where a transform has shear, it stays as it is.
    """
    found = np.array(coefficients, dtype=np.float64)
    found[:, 6:] = _nearest(found[:, 6:], _factors(rig, found), lower[:, 6:], upper[:, 6:])
    return found


def _factors(rig: Rig, coefficients: FloatArray) -> FloatArray:
    """(m, 3) scales of the local transforms, by those of the coefficients; NaN where there are none."""
    local = decompose(rig.local_transforms(coefficients))
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = local.scale / coefficients[:, 6:]
    return np.where(local.sheared[:, None] | (factors == 0) | ~np.isfinite(factors), np.nan, factors)


def _nearest(values: FloatArray, factors: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Values, one by one the nearest inside the limits whose products with `factors` are half precision."""
    local = values * factors
    nearest = _half(local)
    done = ~np.isfinite(nearest) | (np.abs(nearest - local) <= _SAME * np.abs(local))
    found = np.array(values, dtype=np.float64)
    for half in (nearest, _beside(nearest, np.inf), _beside(nearest, -np.inf)):
        tried = (half / factors).astype(np.float32).astype(np.float64)
        fits = ~done & (lower <= tried) & (tried <= upper)
        found = np.where(fits, tried, found)
        done = done | fits
    return found


def _half(values: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(np.asarray(values).astype(np.float16).astype(np.float64))


def _beside(halves: FloatArray, direction: float) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(np.nextafter(halves.astype(np.float16), np.float16(direction)).astype(np.float64))
