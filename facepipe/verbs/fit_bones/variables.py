"""The unknowns of a bone fit: the coefficients that may move, each once where the two sides move as mirror images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import mirrored_names
from facepipe.rig import CHANNELS, Rig, rest_coefficients

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
    partners, single = _partners(rig), []
    for joint in np.flatnonzero(tied):
        partner = partners[joint]
        if partner is None or not tied[partner]:
            single.append(rig.joints[joint])
            continue
        if partner < joint:
            continue  # the other way round
        flips = _flips(axes[joint], axes[partner], f"{rig.name} -> {rig.joints[joint]}", rig.joints[partner])
        followers = slice(9 * partner, 9 * partner + 9)
        if partner == joint:
            # a joint on the middle is its own mirror image: c = -c leaves 0 alone
            still[followers] = flips < 0
        else:
            leaders[followers], signs[followers] = 9 * joint + np.arange(9), flips
    if (leaders == np.arange(9 * count)).all():
        raise InputError(rig.name, "no pairs of joints, expected names with left and right, or L and R")
    return Symmetry(rig.joints, leaders, signs, still, tuple(single))


def _partners(rig: Rig) -> list[int | None]:
    """The joint on the other side, itself for one in the middle; None for one of a side that has no partner.

    Of several joints of a name it is the one below the partner of the joint above.
    """
    named: dict[str, list[int]] = {}
    names = [joint.rpartition("/")[2] for joint in rig.joints]
    for number, name in enumerate(names):
        named.setdefault(name, []).append(number)
    partners: list[int | None] = []
    for number, (name, above) in enumerate(zip(names, rig.parents, strict=True)):
        others = mirrored_names(name)
        wanted = partners[above] if above >= 0 else -1
        options = next((named[other] for other in others if other in named), [])
        below = [option for option in options if rig.parents[option] == wanted] or options
        partners.append(number if not others else below[0] if len(below) == 1 else None)
    return [other if other is not None and partners[other] == own else None for own, other in enumerate(partners)]


def _flips(one: FloatArray, other: FloatArray, where: str, partner: str) -> FloatArray:
    """(9,) signs of the coefficients of a joint with axes (3, 3), seen as those of its partner."""
    turned = np.linalg.solve(one, np.array([-1.0, 1.0, 1.0])[:, None] * other)  # where axes are as long, +-1 each
    axes = np.sign(np.diag(turned))
    if np.abs(turned - np.diag(axes)).max() > _OBLIQUE:
        what = f"its axes at rest are no mirror image of {partner}'s, expected that for a symmetric fit"
        raise InputError(where, what)
    return np.concatenate([axes, -axes, np.ones(3)])  # mirroring turns rotations about what it keeps
