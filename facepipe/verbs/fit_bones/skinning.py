"""How a skinned face answers to bone coefficients, with derivatives, and the unknowns of a fit: each free one once.

A skinned point ``x_i = sum_d X_d (w_id q_i)`` is linear in the skinning matrices X_d (3 x 4; q_i the homogeneous rest
point). So the weighted squared distance to a target, its gradient and the Gauss-Newton matrix need no sum over points
but the moments ``Q = A^T W A`` and ``T = A^T W t``, where row i of A holds ``w_id q_i``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import mirrored_names
from facepipe.rig import CHANNELS, Rig, coefficient_matrices, rest_coefficients
from facepipe.rig.bone_coefficients import coefficient_curvatures, coefficient_derivatives, coefficient_gradient

_OBLIQUE = 0.1  # how far a mirrored axis of a joint at rest may be off, of its length


class Variables:
    """v unknowns for the coefficients of m joints, with their limits.

    :param lower: (m, 9)
    :param upper: (m, 9)
    :param free: (m,) joints that may move
    :param levers: (9,) how far a channel moves points, about: 1 of translations, a length of angles and scales
    :param symmetry: ties coefficients to others, whose limits are mirror images
    """

    def __init__(
        self, lower: FloatArray, upper: FloatArray, free: BoolArray, levers: FloatArray, symmetry: Symmetry | None
    ) -> None:
        moving = np.flatnonzero((free[:, None] & (lower < upper)).ravel())
        self.shape = lower.shape
        self.joints: IntArray = np.unique(moving // 9)  # (f,) those with an unknown
        self._flat = moving  # (c,) coefficients that move
        leaders = moving if symmetry is None else symmetry.leaders[moving]
        leading, self._variable = np.unique(leaders, return_inverse=True)  # (v,), (c,)
        self._sign = np.ones(len(moving)) if symmetry is None else symmetry.signs[moving]
        self._tied = symmetry is not None
        self.lower, self.upper = lower.ravel()[leading], upper.ravel()[leading]  # (v,)
        self._squares = levers[leading % 9] ** 2  # (v,)
        self._inside = (np.searchsorted(self.joints, moving // 9) * 9) + moving % 9  # (c,) among those of `joints`

    def __len__(self) -> int:
        return len(self.lower)

    def reduced(self, coefficients: FloatArray) -> FloatArray:
        """(v,) the unknowns of (m, 9) coefficients: means of what is tied, inside the limits."""
        count = np.maximum(np.bincount(self._variable, minlength=len(self)), 1)
        return np.clip(self.gradient(coefficients) / count, self.lower, self.upper)

    def expanded(self, x: FloatArray, others: FloatArray) -> FloatArray:
        """(..., m, 9) coefficients of (..., v) unknowns; those that don't move as in (m, 9)."""
        full = np.broadcast_to(others.ravel(), (*x.shape[:-1], others.size)).copy()
        full[..., self._flat] = x[..., self._variable] * self._sign
        return full.reshape(*x.shape[:-1], *self.shape)

    def gradient(self, by_coefficient: FloatArray) -> FloatArray:
        """(..., v) derivatives by the unknowns, of those by coefficients (..., m, 9)."""
        moving = by_coefficient.reshape(*by_coefficient.shape[:-2], -1)[..., self._flat] * self._sign
        if not self._tied:
            return moving
        summed = np.zeros((*moving.shape[:-1], len(self)))
        np.add.at(np.moveaxis(summed, -1, 0), self._variable, np.moveaxis(moving, -1, 0))
        return summed

    def floored(self, diagonal: FloatArray, share: float) -> FloatArray:
        """(v,) of a matrix's diagonal, each element at least a share of the largest, whatever the units are."""
        largest = max(float((diagonal / self._squares).max(initial=0.0)), float(np.finfo(np.float64).tiny))
        return np.asarray(np.maximum(diagonal, share * largest * self._squares))

    def matrix(self, by_coefficient: FloatArray) -> FloatArray:
        """(v, v) of a symmetric matrix (9 f, 9 f) over the coefficients of `joints`."""
        if len(self._inside) < len(by_coefficient):
            by_coefficient = by_coefficient[np.ix_(self._inside, self._inside)]
        if not self._tied:
            return by_coefficient
        from scipy.sparse import csr_array

        ties = csr_array((self._sign, (np.arange(len(self._sign)), self._variable)), (len(self._sign), len(self)))
        return np.asarray(ties.T @ (ties.T @ by_coefficient).T)


@dataclass(frozen=True)
class Symmetry:
    """The ties of 9m coefficients, flat: each is its sign times that of its leader, which may be itself."""

    joints: tuple[str, ...]
    leaders: IntArray  # (9 m,)
    signs: FloatArray  # (9 m,) 1 or -1
    still: BoolArray  # (9 m,) coefficients of joints in the middle that mirroring would turn round: they rest
    single: tuple[str, ...]  # joints of one side without a partner: not tied

    def limits(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m, 9) limits that tied coefficients share, as mirror images.

        :raises InputError: limits that have nothing in common, or that exclude rest where a joint must keep it
        """
        low, high, rest = lower.ravel().copy(), upper.ravel().copy(), rest_coefficients(len(lower)).ravel()
        follower = np.flatnonzero(self.leaders != np.arange(len(low)))
        leader, turned = self.leaders[follower], self.signs[follower] < 0
        mirrored = (np.where(turned, -high[follower], low[follower]), np.where(turned, -low[follower], high[follower]))
        low[leader], high[leader] = np.maximum(low[leader], mirrored[0]), np.minimum(high[leader], mirrored[1])
        self._check(low > high, "limits that are no mirror images: no value is inside both")
        low[follower] = np.where(turned, -high[leader], low[leader])
        high[follower] = np.where(turned, -low[leader], high[leader])
        wrong = self.still & ((low > rest) | (high < rest))
        self._check(wrong, "limits without 0, which a symmetric fit keeps it at")
        low[self.still] = high[self.still] = rest[self.still]
        return low.reshape(lower.shape), high.reshape(upper.shape)

    def _check(self, wrong: BoolArray, what: str) -> None:
        if wrong.any():
            joint, channel = divmod(int(np.argmax(wrong)), 9)
            raise InputError(f"limits -> {self.joints[joint]} -> {CHANNELS[channel]}", what)


def symmetry(rig: Rig, tied: BoolArray) -> Symmetry:
    """The ties of joints by their names (``left`` and ``right``, or ``L`` and ``R`` as a word of its own).

    The axes of a joint at rest and of its partner, mirrored across x, must be the same up to their signs.

    :param tied: (m,) joints that count
    :raises InputError: no joint has a partner, or the axes of two are no mirror images
    """
    count = len(rig.joints)
    leaders, signs, still = np.arange(9 * count), np.ones(9 * count), np.zeros(9 * count, dtype=np.bool_)
    axes = rig.joint_worlds(rig.rest)[:, :3, :3]
    # the joint on the other side, itself for one in the middle; None for one of a side that has no partner. Of several
    # joints of a name it is the one below the partner of the joint above.
    named: dict[str, list[int]] = {}
    names = [joint.rpartition("/")[2] for joint in rig.joints]
    for number, name in enumerate(names):
        named.setdefault(name, []).append(number)
    found: list[int | None] = []
    for number, (name, above) in enumerate(zip(names, rig.parents, strict=True)):
        others = mirrored_names(name)
        wanted = found[above] if above >= 0 else -1
        options = next((named[other] for other in others if other in named), [])
        below = [option for option in options if rig.parents[option] == wanted] or options
        found.append(number if not others else below[0] if len(below) == 1 else None)
    partners = [other if other is not None and found[other] == own else None for own, other in enumerate(found)]
    single = []
    for joint in np.flatnonzero(tied):
        partner = partners[joint]
        if partner is None or not tied[partner]:
            single.append(rig.joints[joint])
            continue
        if partner < joint:
            continue  # the other way round
        # the other's axes mirrored, in one's own: where axes are as long, +-1 each
        turned = np.linalg.solve(axes[joint], np.array([-1.0, 1.0, 1.0])[:, None] * axes[partner])
        along = np.sign(np.diag(turned))
        if np.abs(turned - np.diag(along)).max() > _OBLIQUE:
            what = f"its axes at rest are no mirror image of {rig.joints[partner]}'s, expected that for a symmetric fit"
            raise InputError(f"{rig.name} -> {rig.joints[joint]}", what)
        flips = np.concatenate([along, -along, np.ones(3)])  # mirroring turns rotations about what it keeps
        followers = slice(9 * partner, 9 * partner + 9)
        if partner == joint:
            # a joint on the middle is its own mirror image: c = -c leaves 0 alone
            still[followers] = flips < 0
        else:
            leaders[followers], signs[followers] = 9 * joint + np.arange(9), flips
    if (leaders == np.arange(9 * count)).all():
        raise InputError(rig.name, "no pairs of joints, expected names with left and right, or L and R")
    return Symmetry(rig.joints, leaders, signs, still, tuple(single))


@dataclass(frozen=True)
class Pose:
    """A pose of the tree, or many."""

    coefficients: FloatArray  # (..., m, 9)
    local: FloatArray  # (..., m, 4, 4)
    worlds: FloatArray  # (..., m, 4, 4)
    skinning: FloatArray  # (..., m, 4, 4) world times inverse bind


class Tree:
    """The joints of a rig, parents first, and its points as a linear function of their skinning matrices."""

    def __init__(self, rig: Rig, parent_world: FloatArray | None = None) -> None:
        from scipy.sparse import csr_array

        self.rig = rig
        self.parent_world = rig.parent_world if parent_world is None else parent_world
        below = np.eye(len(rig.joints))  # (m, m) 1 where the column's joint is the row's or below it
        for joint in range(len(rig.joints) - 1, -1, -1):
            if rig.parents[joint] >= 0:
                below[rig.parents[joint]] += below[joint]
        self.below = below
        self.flat = bool((rig.parents < 0).all())  # no joint below another
        count = len(rig.joints)
        homogeneous = np.concatenate([rig.points, np.ones((len(rig.points), 1))], axis=1)
        weights = rig.influences[:, :count].tocsr()
        each = homogeneous[np.repeat(np.arange(len(rig.points)), np.diff(weights.indptr))]
        columns = (weights.indices[:, None] * 4 + np.arange(4)).ravel()
        data = (weights.data[:, None] * each).ravel()
        self.rows = csr_array((data, columns, weights.indptr * 4), shape=(len(rig.points), 4 * count))  # A
        # (n, 3) what hangs at the skeleton itself adds to each point
        self._held = rig.influences[:, [count]].toarray() * homogeneous @ self.parent_world[:3].T

    def pose(self, coefficients: FloatArray) -> Pose:
        """The pose of (..., m, 9) coefficients."""
        local = self.rig.rest @ coefficient_matrices(coefficients)
        worlds = self.rig.joint_worlds(local, self.parent_world)
        return Pose(coefficients, local, worlds, worlds @ self.rig.inverse_bind)

    def generators(self, pose: Pose) -> FloatArray:
        """(m, 9, 4, 4) G with ``d world_d / d c_ja = G_ja world_d`` for every joint d at or below joint j.

        :raises numpy.linalg.LinAlgError: a joint with scale 0
        """
        change = self._above(pose)[:, None] @ coefficient_derivatives(pose.coefficients)
        return np.asarray(change @ np.linalg.inv(pose.worlds)[:, None])

    def gradient(self, pose: Pose, by_matrix: FloatArray) -> FloatArray:
        """(..., m, 9) derivatives by the coefficients of what has (..., m, 4, 3) by the rows of skinning matrices."""
        by_world = np.swapaxes(by_matrix, -1, -2) @ np.swapaxes(self.rig.inverse_bind, -1, -2)
        for joints in self.rig.generations[:0:-1]:  # the deepest first
            passed = by_world[..., joints, :, :] @ np.swapaxes(pose.local[..., joints, :, :], -1, -2)
            np.add.at(np.moveaxis(by_world, -3, 0), self.rig.parents[joints], np.moveaxis(passed, -3, 0))
        own = np.swapaxes(self._above(pose)[..., :3, :], -1, -2) @ by_world
        return coefficient_gradient(pose.coefficients, own)

    def _above(self, pose: Pose) -> FloatArray:
        """(..., m, 4, 4) what comes before each joint's own matrix."""
        parents = self.rig.parents
        if self.flat:
            return np.asarray(self.parent_world @ self.rig.rest)
        worlds = pose.worlds[..., np.maximum(parents, 0), :, :]
        return np.asarray(np.where((parents >= 0)[:, None, None], worlds, self.parent_world) @ self.rig.rest)

    def curvature(self, generators: FloatArray, pose: Pose, by_matrix: FloatArray, free: IntArray) -> FloatArray:
        """(9 f, 9 f) what the second derivatives of the skinning matrices add to the Gauss-Newton matrix.

        A joint above another acts first: ``d2 world_d / d c_ja d c_kb = G_ja G_kb world_d``.
        """
        f = len(free)
        moved = np.swapaxes(by_matrix, -1, -2) @ np.swapaxes(pose.skinning, -1, -2)
        below = np.tensordot(self.below[free], moved, (1, 0))  # (f, 3, 4) by a matrix left of all at or below a joint
        matrix = np.zeros((f, 9, f, 9))
        inverse = np.linalg.inv(pose.worlds[free])
        by_own = np.swapaxes(self._above(pose)[free][:, :3], -1, -2) @ below @ np.swapaxes(inverse, -1, -2)
        own = coefficient_curvatures(pose.coefficients[free]).reshape(f, 81, 16)
        matrix[np.arange(f), :, np.arange(f)] = (own @ by_own.reshape(f, 16, 1)).reshape(f, 9, 9)
        above = self.below[np.ix_(free, free)] - np.eye(f)
        first, second = np.nonzero(above)
        upper = generators[free][:, :, :3].reshape(f, 9, 12)
        lower = np.swapaxes(generators[free] @ np.swapaxes(below, -1, -2)[:, None], -1, -2).reshape(f, 9, 12)
        blocks = upper[first] @ np.swapaxes(lower[second], -1, -2)
        matrix[first, :, second] = blocks
        matrix[second, :, first] = np.swapaxes(blocks, -1, -2)
        return matrix.reshape(9 * f, 9 * f)

    def normal_matrix(self, generators: FloatArray, pose: Pose, pairs: FloatArray, free: IntArray) -> FloatArray:
        """(9 f, 9 f) Gauss-Newton matrix over the coefficients of the `free` joints, of moments (4m, 4m)."""
        count, f = len(pose.skinning), len(free)
        blocks = pairs.reshape(count, 4, count, 4).transpose(0, 2, 1, 3)
        shared = pairs[3::4, 3::4] != 0  # sums of products of weights
        sharing = np.nonzero(shared)
        moved = pose.skinning[sharing[0]] @ blocks[sharing] @ pose.skinning[sharing[1]].transpose(0, 2, 1)
        everything = np.zeros((count, count, 16))
        everything[sharing] = moved.reshape(-1, 16)
        # pairs of `free` joints that move the same points, each once, and their moments (p, 4, 4) in this pose, summed
        # over the joints at or below either end
        if self.flat:
            first, second = np.nonzero(np.triu(shared[np.ix_(free, free)]))
            summed = everything[free[first], free[second]].reshape(-1, 4, 4)
        else:
            below = self.below[free]
            first, second = np.nonzero(np.triu(below @ shared @ below.T))
            half = (below @ everything.reshape(count, -1)).reshape(f, count, 16)
            summed = np.matmul(below, half)[first, second].reshape(-1, 4, 4)
        own = np.ascontiguousarray(generators[free][:, :, :3])  # (f, 9, 3, 4)
        left = np.matmul(own.reshape(f, 27, 4)[first], summed).reshape(-1, 9, 12)
        right = own.reshape(f, 9, 12).transpose(0, 2, 1)
        blocks = np.matmul(left, right[second])
        matrix = np.zeros((f, 9, f, 9))
        matrix[first, :, second] = blocks
        matrix[second, :, first] = blocks.transpose(0, 2, 1)
        return matrix.reshape(9 * f, 9 * f)

    def evaluate(self, matrices: FloatArray) -> FloatArray:
        """(n, 3) points of (m, 4, 4) skinning matrices."""
        return np.asarray(self.rows @ stacked(matrices) + self._held)

    def moments(self, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``Q`` (4m, 4m) and ``T`` (4m, 3) for a target (n, 3) under point weights (n,)."""
        weighted = self.rows.T.multiply(weights[None]).tocsr()
        return (weighted @ self.rows).toarray(), np.asarray(weighted @ (target - self._held))

    def goal(self, target: FloatArray, weights: FloatArray) -> FloatArray:
        """``T`` alone: ``Q`` is of the weights, and serves other targets (n, 3)."""
        return np.asarray(self.rows.T @ (weights[:, None] * (target - self._held)))


def applied(pairs: FloatArray, rows: FloatArray) -> FloatArray:
    """``Q`` times (..., 4m, 3)."""
    many = np.moveaxis(rows, -2, 0)
    return np.moveaxis((pairs @ many.reshape(len(many), -1)).reshape(many.shape), 0, -2)


def slopes(pairs: FloatArray, goal: FloatArray, matrices: FloatArray) -> FloatArray:
    """(m, 4, 3) derivatives of half the weighted squared distance by (m, 4, 4) skinning matrices' rows."""
    return np.asarray((applied(pairs, stacked(matrices)) - goal).reshape(-1, 4, 3))


def stacked(matrices: FloatArray) -> Any:
    """(..., 4m, 3) of (..., m, 4, 4) skinning matrices: what A is multiplied with."""
    rows = np.swapaxes(matrices[..., :3, :], -1, -2)
    return np.ascontiguousarray(rows).reshape(*matrices.shape[:-3], -1, 3)
