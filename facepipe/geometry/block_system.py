"""Normal equations of least squares over small groups of points, in 3 x 3 blocks of points and of pairs of points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, kw_only=True)
class Groups:
    """m groups of v points each, and where their blocks go. Points of -1 are given: they have no unknowns."""

    points: IntArray  # (m, v)
    between: tuple[
        IntArray, ...
    ]  # for each two members: (m,) link of that pair, or one past the last where it has none

    @classmethod
    def of(cls, points: IntArray, count: int, links: IntArray) -> Groups:
        """Groups among `count` points.

        :param links: ascending ``lower * count + higher`` of pairs of points, with all pairs of the groups
        """
        found = []
        for one, other in combinations(range(points.shape[1]), 2):
            low, high = np.sort(points[:, [one, other]], axis=1).T
            at = np.searchsorted(links, low * count + high)
            found.append(np.where(low >= 0, at, len(links)))
        return cls(points=points, between=tuple(found))


def pairs_within(points: IntArray) -> IntArray:
    """(p, 2) pairs of points of the same group (m, v), without those of -1."""
    two = [points[:, pair] for pair in combinations(range(points.shape[1]), 2)]
    pairs = np.concatenate([np.zeros((0, 2), np.int64), *two])
    return np.asarray(pairs[(pairs >= 0).all(axis=1)])


class BlockSystem:
    """``A x = b`` of a sum of weighted squares, gathered group by group.

    :param count: points
    :param links: number of pairs of points with blocks
    """

    def __init__(self, count: int, links: int) -> None:
        self.own = np.zeros((count, 3, 3))
        self.between = np.zeros((links, 3, 3))  # rows of the lower point
        self.right = np.zeros((count, 3))

    def add(self, groups: Groups, jacobian: FloatArray, residual: FloatArray, weights: FloatArray) -> None:
        """Add ``sum_m weight |residual + jacobian x|^2``.

        :param jacobian: (m, q, 3v) and `residual` (m, q)
        :param weights: (m,)
        """
        members = groups.points.shape[1]
        weighted = weights[:, None, None] * jacobian
        right = np.einsum("mqi,mq->mi", weighted, residual).reshape(-1, members, 3)
        squares = (weighted.transpose(0, 2, 1) @ jacobian).reshape(-1, members, 3, members, 3)
        for member in range(members):
            points = groups.points[:, member]
            _gather(self.own, points, squares[:, member, :, member])
            _gather(self.right, points, -right[:, member])
        for at, (one, other) in zip(groups.between, combinations(range(members), 2), strict=True):
            block = squares[:, one, :, other]
            turned = (groups.points[:, one] > groups.points[:, other])[:, None, None]
            _gather(self.between, at, np.where(turned, block.transpose(0, 2, 1), block))


def _gather(into: FloatArray, at: IntArray, values: FloatArray) -> None:
    """Add rows of `values` to rows of `into`; those at -1 or past the end go nowhere."""
    count = len(into)
    flat = into.reshape(count, -1)
    place = np.where(at < 0, count, at)
    for column, one in enumerate(values.reshape(len(values), -1).T):
        flat[:, column] += np.bincount(place, one, minlength=count + 1)[:count]
