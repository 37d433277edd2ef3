"""Least-squares similarity and rigid fits of one point set onto another, one at a time or by groups."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.vectors import finite, group_sums

# Singular values below this share of the largest have no direction: a set 1e-5 as thick as it is long is a line.
_LINE_THICKNESS = 1e-10
# A spread below this share of the coordinates is rounding: the set is one point.
_POINT_SPREAD = 1e-12
_TRIALS = 300  # of four pairs: with a third of them wrong one in five is clean
_PAIRS_A_TRIAL = 4
_INLIER_REACH = 2.5  # times the robust standard deviation


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """``target = scale rotation source + translation``."""

    rotation: FloatArray  # (3, 3), proper
    translation: FloatArray  # (3,)
    scale: float = 1.0

    def apply(self, points: FloatArray) -> FloatArray:
        """(..., 3) points moved."""
        return np.asarray(self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation)

    def undo(self, points: FloatArray) -> FloatArray:
        """(..., 3) points moved back; the scale must not be 0."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.translation) @ self.rotation / self.scale)


@dataclass(frozen=True, kw_only=True)
class Similarities:
    """One similarity a group."""

    rotation: FloatArray  # (g, 3, 3), proper
    translation: FloatArray  # (g, 3)
    scale: FloatArray  # (g,)

    def __getitem__(self, group: int) -> Similarity:
        """The similarity of one group."""
        return Similarity(
            rotation=self.rotation[group], translation=self.translation[group], scale=float(self.scale[group])
        )

    def apply(self, points: FloatArray, groups: IntArray) -> FloatArray:
        """(n, 3) points moved, each by the similarity of its group (n,)."""
        turned = np.einsum("nij,nj->ni", self.rotation[groups], np.asarray(points, dtype=np.float64))
        return np.asarray(self.scale[groups, None] * turned + self.translation[groups])


def fit_similarity(
    source: FloatArray, target: FloatArray, *, scale: bool = True, weights: FloatArray | None = None
) -> Similarity:
    """The similarity that moves `source` (n, 3) closest to `target` (n, 3), by the weighted sum of squared distances.

    Never a reflection. Where the points leave the rotation open it is the smallest one that fits: about a line, the
    shortest arc between the lines; for one point, or points that are all equal, none, with scale 1.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991,
    eq. (40)-(42).

    :param scale: fit the scale too; False gives the rigid fit
    :param weights: (n,), 0 or more, not all 0
    :raises InputError: NaN or infinity
    """
    one_group = np.zeros(len(source), dtype=np.int64)
    return fit_similarities(source, target, one_group, scale=scale, weights=weights)[0]


def fit_similarities(
    source: FloatArray,
    target: FloatArray,
    groups: IntArray,
    *,
    scale: bool = True,
    weights: FloatArray | None = None,
) -> Similarities:
    """`fit_similarity` for every group of points at once.

    :param source: (n, 3), n at least 1
    :param target: (n, 3)
    :param groups: (n,) group of every point, 0 or more; a number without points gives the identity
    :param weights: (n,), 0 or more, not all 0 in any group
    :return: groups 0 to the largest number
    :raises InputError: NaN or infinity
    """
    source, target, count = finite("source", source), finite("target", target), int(groups.max()) + 1
    given = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64) / np.max(weights)
    share = (given / np.bincount(groups, given)[groups])[:, None]
    from_centre, to_centre = group_sums(groups, source * share, count), group_sums(groups, target * share, count)
    # in units of the largest coordinate, so that no square overflows
    from_unit, to_unit = _largest(source), _largest(target)
    a, b = (source - from_centre[groups]) / from_unit, (target - to_centre[groups]) / to_unit
    covariance = np.stack([group_sums(groups, b * share * a[:, axis, None], count) for axis in range(3)], axis=2)
    from_variance = group_sums(groups, a * a * share, count).sum(axis=1)
    to_variance = group_sums(groups, b * b * share, count).sum(axis=1)
    spread = (from_variance > _POINT_SPREAD**2) & (to_variance > _POINT_SPREAD**2)
    # ``R = U S V^T`` of the covariance ``U D V^T``, with ``S = diag(1, 1, det U det V)``: the nearest rotation, no
    # reflection; the trace of D S is its strength, 0 where it is left at identity
    U, D, Vt = np.linalg.svd(covariance)
    signs = np.ones_like(D)
    signs[:, 2] = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    rotation = (U * signs[:, None, :]) @ Vt
    line = D[:, 1] <= _LINE_THICKNESS * D[:, 0]
    start = Vt[line, 0]
    end = U[line, :, 0]
    # a half-turn about `start`, then one about the vector halfway to `end`; across `start` where they are opposite
    halfway = start + end
    length = np.linalg.norm(halfway, axis=1)
    opposite = length < 1e-8
    across = np.eye(3)[np.abs(start).argmin(axis=1)]
    across -= (across * start).sum(axis=1, keepdims=True) * start
    halfway = np.where(opposite[:, None], across, halfway)
    halfway = halfway / np.linalg.norm(halfway, axis=1, keepdims=True)
    rotation[line] = np.asarray(_half_turns(halfway) @ _half_turns(start))
    unknown = ~spread | (D[:, 0] <= np.finfo(np.float64).tiny)
    rotation[unknown] = np.eye(3)
    strength = np.where(unknown, 0.0, (D * signs).sum(axis=1))
    factor = np.ones(count)
    if scale:
        fitted = strength > 0
        factor[fitted] = strength[fitted] / from_variance[fitted] * (to_unit / from_unit)
    moved = factor[:, None] * np.einsum("gij,gj->gi", rotation, from_centre)
    return Similarities(rotation=rotation, translation=to_centre - moved, scale=factor)


def _half_turns(axis: FloatArray) -> FloatArray:
    return np.asarray(2.0 * axis[:, :, None] * axis[:, None, :] - np.eye(3))


def _largest(points: FloatArray) -> float:
    return max(float(np.abs(points).max()), np.finfo(np.float64).tiny)


def robust_similarity(source: FloatArray, target: FloatArray, *, scale: bool = True, seed: int = 0) -> Similarity:
    """The similarity that moves `source` (n, 3) onto `target` (n, 3) by the least median of squared distances, refined
    on the pairs that fit it. Up to a third of the pairs may be wrong.

    Rousseeuw, "Least median of squares regression", Journal of the American Statistical Association 1984.

    :raises InputError: as `fit_similarity`
    """
    count = len(source)
    best = fit_similarity(source, target, scale=scale)
    if count <= _PAIRS_A_TRIAL:
        return best
    rng = np.random.default_rng(seed)
    off = np.linalg.norm(best.apply(source) - target, axis=1)
    least = float(np.median(off))
    chosen = np.concatenate([rng.choice(count, _PAIRS_A_TRIAL, replace=False) for _ in range(_TRIALS)])
    groups = np.repeat(np.arange(_TRIALS), _PAIRS_A_TRIAL)
    # of 60 pairs with noise of 0.3, 20 of them wrong by 50, plain least squares is 11 off on average, this at most 0.2
    tried = fit_similarities(source[chosen], target[chosen], groups, scale=scale)
    for trial in range(_TRIALS):
        distances = np.linalg.norm(tried[trial].apply(source) - target, axis=1)
        if np.median(distances) < least:
            least, off = float(np.median(distances)), distances
    # as many pairs as a trial takes, at least: half of five or six would be fewer
    inside = off <= max(_INLIER_REACH * 1.4826 * least, np.sort(off)[_PAIRS_A_TRIAL - 1])
    return fit_similarity(source[inside], target[inside], scale=scale)
