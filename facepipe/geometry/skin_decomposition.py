"""Skin weights and joint transforms that reproduce example shapes: skinning decomposition with rigid joints.

    minimise  sum_s sum_i |sum_j w_ij (R_sj x_i + t_sj) - y_si|^2  +  evenness |w_i - mean of the neighbours' w|^2

over weights w on the simplex (w_ij >= 0, in sum 1, few of them above 0) and rigid transforms (R, t) of every joint in
every example, in turns: transforms joint by joint in closed form (weighted Procrustes on what the other joints leave),
weights by a small convex problem a point, over the joints that are near it.

Source: Le & Deng, "Smooth Skinning Decomposition with Rigid Bones", SIGGRAPH Asia 2012, sections 4.1 (weights) and 4.2
(transforms); the term of neighbours after Le & Deng, "Robust and accurate skeletal rigging from mesh sequences",
SIGGRAPH 2014, section 4.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.warp import nearest_rotations

_SETTLING_SWEEPS = 6  # over all joints, where weights stay as they are
_GRADIENT_STEPS = 80  # of projected gradient a round
_STAY_PULL = 0.1  # pull towards the first weights, of that towards the neighbours: points that never move keep theirs
_LIKELY_WEIGHT = 0.05  # first weights from here on cost nothing
_HIGHEST_PRICE = 1e3  # most that a weight costs, against the pull of the neighbours
_ROTATION_KEPT = 1e-4  # of the spread of a joint's points: how much it keeps to the rotation it has
_VALUES_AT_ONCE = 1 << 20  # numbers of the points' systems at a time: a bound on memory


@dataclass(frozen=True, kw_only=True)
class Decomposition:
    """The weights of a decomposition, and its distances from the examples."""

    weights: FloatArray  # (n, k) of the candidates
    before: FloatArray  # (s, n) distances with the first weights, cut, and transforms fitted to them
    after: FloatArray  # (s, n) with `weights`


def decompose(
    rest: FloatArray,
    shapes: FloatArray,
    edges: IntArray,
    candidates: IntArray,
    weights: FloatArray,
    *,
    most: int,
    iterations: int,
    evenness: float,
    step: Callable[[], object] = lambda: None,
) -> Decomposition:
    """Refine weights for example shapes; the best round counts.

    :param rest: (n, 3)
    :param shapes: (s, n, 3) points of every example
    :param edges: (e, 2) neighbours
    :param candidates: (n, k) different joints that each point may have
    :param weights: (n, k) to begin with, rows in sum 1; a candidate with 0 is never used
    :param most: weights above 0 a point
    :param iterations: rounds of weights and transforms
    :param evenness: pull towards the neighbours' mean, of the mean square motion of points over all examples
    :param step: called after every round
    """
    solver = _Solver(rest, shapes, edges, candidates, weights, evenness)
    kept = np.where(largest(weights, most), weights, 0.0)
    current = np.asarray(kept / kept.sum(axis=1, keepdims=True))
    solver.settle(current)
    before = after = solver.residuals(current)
    best = current
    for _ in range(iterations):
        current = solver.fitted_weights(current, most)
        solver.fit_transforms(current)
        found = solver.residuals(current)
        # weights pay for more than the distance (neighbours, few joints), and are cut: nothing makes each round nearer
        if (found**2).sum() < (after**2).sum():
            best, after = current, found
        step()
    return Decomposition(weights=best, before=before, after=after)


class _Solver:
    """The transforms, and what stays the same all the time."""

    def __init__(
        self,
        rest: FloatArray,
        shapes: FloatArray,
        edges: IntArray,
        candidates: IntArray,
        weights: FloatArray,
        evenness: float,
    ) -> None:
        self.allowed = weights > 0
        self._rest, self._motion = np.asarray(rest, np.float64), np.asarray(shapes, np.float64) - rest
        self._candidates, self._first = candidates, weights
        self._count = int(candidates.max(initial=0)) + 1
        self._R = np.tile(np.eye(3), (self._count, len(shapes), 1, 1))
        self._t = np.zeros((self._count, len(shapes), 3))
        self._uses = [np.nonzero((candidates == joint) & self.allowed) for joint in range(self._count)]
        self._neighbours = neighbour_means(edges, len(rest))
        self._pull = evenness * float((self._motion**2).sum(axis=(0, 2)).mean()) + np.finfo(np.float64).tiny

    def settle(self, weights: FloatArray) -> None:
        """Fit transforms until they hardly change any more."""
        for _ in range(_SETTLING_SWEEPS):
            self.fit_transforms(weights)

    def _displacement(self, joint: int, rows: IntArray) -> FloatArray:
        """(s, r, 3) how a joint alone moves points."""
        at = self._rest[rows]
        return np.asarray(at @ (self._R[joint] - np.eye(3)).transpose(0, 2, 1) + self._t[joint, :, None])

    def _blended(self, weights: FloatArray) -> FloatArray:
        """(s, n, 3) how all move them."""
        moved = np.zeros_like(self._motion)
        for joint, (rows, slots) in enumerate(self._uses):
            if len(rows):  # a point has a joint once: no row is there twice
                moved[:, rows] += weights[rows, slots][:, None] * self._displacement(joint, rows)
        return moved

    def residuals(self, weights: FloatArray) -> FloatArray:
        """(s, n) distances from the examples."""
        return np.asarray(np.linalg.norm(self._blended(weights) - self._motion, axis=2))

    def fit_transforms(self, weights: FloatArray) -> None:
        """One sweep over the joints (section 4.2)."""
        left = self._motion - self._blended(weights)
        for joint, (rows, slots) in enumerate(self._uses):
            shares = weights[rows, slots]
            rows, shares = rows[shares > 0], shares[shares > 0]
            if not len(rows):
                continue
            share = shares[:, None] * self._displacement(joint, rows)
            goal = left[:, rows] + share
            # the rigid transform whose displacement times `shares` (r,) is nearest to `goal` (s, r, 3). Minimises
            # ``sum_i |w_i (R x_i + t - x_i) - g_i|^2``. With the mean ``m = sum w^2 x / sum w^2`` and where it goes,
            # ``m' = m + sum w g / sum w^2``: R is the rotation nearest to ``sum (w^2 (x - m) + w g) (x - m)^T``, ``t =
            # m' - R m``.
            at, total = self._rest[rows], float((shares**2).sum())
            middle = (shares**2) @ at / total
            moved = middle + shares @ goal / total
            local = (at - middle) * shares[:, None]
            spread = local.T @ local
            turned = spread + (local.T @ goal).transpose(0, 2, 1)
            keep = _ROTATION_KEPT * float(np.trace(spread)) + np.finfo(np.float64).tiny
            self._R[joint] = nearest_rotations(turned + keep * self._R[joint])
            self._t[joint] = moved - self._R[joint] @ middle
            left[:, rows] = goal - shares[:, None] * self._displacement(joint, rows)

    def fitted_weights(self, start: FloatArray, most: int) -> FloatArray:
        """(n, k) the weights of least error for these transforms (section 4.1), for the neighbours of `start`.

        First with all candidates, then with the `most` largest alone; those that are hardly among them, or had hardly
        any weight at first, pay for theirs, so that weights go to 0 where points stop having a joint.
        """
        towards = (self._neighbour_means(start) + _STAY_PULL * self._first) / (1.0 + _STAY_PULL)
        unlikely = np.clip(_LIKELY_WEIGHT / np.maximum(self._first, 1e-12) - 1.0, 0.0, _HIGHEST_PRICE)
        whole = self._solved(start, towards, self.allowed, unlikely)
        even = np.where(self.allowed, whole + self._neighbour_means(whole), 0.0)
        chosen = largest(even, most)
        left_out = np.where(chosen, 0.0, even).max(axis=1, keepdims=True)
        close = np.minimum(left_out / np.maximum(even - left_out, 1e-12), _HIGHEST_PRICE)
        return self._solved(np.where(chosen, whole, 0.0), towards, chosen, unlikely + close)

    def _solved(self, start: FloatArray, towards: FloatArray, allowed: BoolArray, price: FloatArray) -> FloatArray:
        """(n, k) minima over the simplex of the allowed.

        :param price: (n, k) of the squares of weights, against the pull of the neighbours
        """
        minima = np.empty_like(start)
        step = max(1, _VALUES_AT_ONCE // (9 * self._candidates.shape[1] * len(self._motion)))
        diagonal = np.arange(start.shape[1])
        for at in range(0, len(start), step):
            part = slice(at, at + step)
            rest, joints = self._rest[part], self._candidates[part]
            count, width = joints.shape
            turned = (self._R - np.eye(3))[joints].reshape(count, -1, 3) @ rest[:, :, None]
            columns = turned.reshape(count, width, -1) + self._t[joints].reshape(count, width, -1)
            columns *= self.allowed[part][:, :, None]
            goal = self._motion[:, part].transpose(1, 0, 2).reshape(count, -1, 1)
            gram, linear = columns @ columns.transpose(0, 2, 1), (columns @ goal)[:, :, 0]
            gram[:, diagonal, diagonal] += self._pull * (1.0 + np.where(allowed[part], price[part], 0.0))
            minima[part] = on_simplex(gram, linear + self._pull * towards[part], start[part], allowed[part])
        return minima

    def _neighbour_means(self, weights: FloatArray) -> FloatArray:
        """(n, k) of the candidates; what neighbours have of other joints is shared out by the simplex."""
        table = np.zeros((len(weights), self._count))
        np.add.at(table, (np.arange(len(weights))[:, None], self._candidates), np.where(self.allowed, weights, 0.0))
        return np.take_along_axis(self._neighbours @ table, self._candidates, axis=1)


def neighbour_means(edges: IntArray, count: int) -> Any:
    """(n, n) sparse means over the neighbours; a point without any is its own."""
    from scipy.sparse import csr_array, diags_array

    alone = np.setdiff1d(np.arange(count), edges)
    rows = np.concatenate([edges[:, 0], edges[:, 1], alone]).astype(np.int32)
    columns = np.concatenate([edges[:, 1], edges[:, 0], alone]).astype(np.int32)
    table = csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return diags_array(1.0 / table.sum(axis=1)) @ table


def on_simplex(gram: FloatArray, linear: FloatArray, start: FloatArray, allowed: BoolArray) -> FloatArray:
    """(n, k) minima of ``w G w / 2 - b w`` over the simplex of the allowed: accelerated projected gradient."""
    bound = np.abs(gram).sum(axis=2).max(axis=1)[:, None]
    current = ahead = _projected(start, allowed)
    momentum = 1.0
    for _ in range(_GRADIENT_STEPS):
        slope = (gram @ ahead[:, :, None])[:, :, 0] - linear
        following = _projected(ahead - slope / bound, allowed)
        grown = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = following + (momentum - 1.0) / grown * (following - current)
        current, momentum = following, grown
    return np.asarray(current)


def _projected(rows: FloatArray, allowed: BoolArray) -> FloatArray:
    """The nearest rows (n, k) of 0 or more in sum 1, 0 where not allowed (Held, Wolfe & Crowder 1974)."""
    values = np.where(allowed, rows, -np.inf)
    ordered = -np.sort(-values, axis=1)
    sums = np.cumsum(np.where(np.isfinite(ordered), ordered, 0.0), axis=1) - 1.0
    places = np.arange(1, rows.shape[1] + 1)
    used = np.maximum((ordered * places > sums).sum(axis=1), 1)
    level = sums[np.arange(len(rows)), used - 1] / used
    return np.asarray(np.maximum(values - level[:, None], 0.0))


def largest(weights: FloatArray, most: int) -> BoolArray:
    """(n, k) the `most` largest of each row, of those above 0."""
    rank = np.argsort(np.argsort(-weights, axis=1, kind="stable"), axis=1, kind="stable")
    return np.asarray((rank < most) & (weights > 0))
