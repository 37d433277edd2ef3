"""The smoothness of a surface that moves in part: neighbouring triangles change alike, and as little as they need."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.deformation_transfer import Neighbours, TriangleChanges


@dataclass(frozen=True, kw_only=True)
class ChangeSmoothness:
    """``smooth * sum_ij w_ij |T_i - T_j|^2 + near * sum_i area_i |T_i - 1|^2`` over neighbouring triangles i and j.

    About ``smooth |grad T|^2 + near |T - 1|^2``, integrated over the surface: changes fade over
    ``sqrt(smooth / near)``. Triangles beside those that move count too, so that a part goes over into what stays
    without a crease.
    """

    changes: TriangleChanges  # of triangles that move
    neighbours: Neighbours
    free: IntArray  # (f,) points that move, ascending
    links: IntArray  # (p,) ascending ``lower * f + higher`` of pairs of those that have terms in common
    smooth: float
    near: float
    _pairs: Groups
    _single: Groups

    @classmethod
    def at_rest(
        cls, points: FloatArray, triangles: IntArray, free: BoolArray, smooth: float, near: float
    ) -> ChangeSmoothness:
        """The smoothness of a surface at rest.

        :param points: (n, 3) and `free` (n,), those that move
        """
        number = np.where(free, np.cumsum(free) - 1, -1)
        touched = free[triangles].any(axis=1)
        # one ring further than what moves: the border would crease if changes beside triangles that stay cost nothing
        beside = np.zeros(len(points), bool)
        beside[triangles[touched]] = True
        changes = TriangleChanges.from_rest(points, triangles[beside[triangles].any(axis=1)])
        neighbours = Neighbours.across_edges(points, changes.triangles, changes.areas).where(free)
        quads, corners = number[neighbours.points], number[changes.triangles]
        count = int(np.count_nonzero(free))
        low, high = np.sort(np.concatenate([pairs_within(quads), pairs_within(corners)]), axis=1).T
        linked = np.unique((low * count + high)[low < high])
        return cls(
            changes=changes,
            neighbours=neighbours,
            free=np.flatnonzero(free),
            links=linked,
            smooth=smooth,
            near=near,
            _pairs=Groups.among(quads, count, linked),
            _single=Groups.among(corners, count, linked),
        )

    def system(self, points: FloatArray) -> BlockSystem:
        """Normal equations for moves of the free points from where all `points` (n, 3) are now."""
        system = BlockSystem(len(self.free), self.links)
        changes, derivative = self.changes.at(points), self.changes.derivative(points)
        differences = self.neighbours.differences(changes)
        slopes = self.neighbours.derivative(derivative)
        system.add(self._pairs, slopes, differences, self.smooth * self.neighbours.weights)
        from_rest = (changes - np.eye(3)).reshape(-1, 9)
        system.add(self._single, derivative, from_rest, self.near * self.changes.areas)
        return system


@dataclass(frozen=True, kw_only=True)
class Groups:
    """m groups of v points each, and where their blocks go. Points of -1 are given: they have no unknowns."""

    points: IntArray  # (m, v)
    between: tuple[IntArray, ...]  # for each two members: (m,) link of that pair, one past the last where there is none

    @classmethod
    def among(cls, points: IntArray, count: int, links: IntArray) -> Groups:
        """Groups among `count` points.

        :param links: ascending ``lower * count + higher`` of pairs of points, with all pairs of the groups
        """
        between = []
        for first, second in combinations(range(points.shape[1]), 2):
            low, high = np.sort(points[:, [first, second]], axis=1).T
            place = np.searchsorted(links, low * count + high)
            between.append(np.where(low >= 0, place, len(links)))
        return cls(points=points, between=tuple(between))


def pairs_within(points: IntArray) -> IntArray:
    """(p, 2) pairs of points of the same group (m, v), without those of -1."""
    two = [points[:, pair] for pair in combinations(range(points.shape[1]), 2)]
    pairs = np.concatenate([np.zeros((0, 2), np.int64), *two])
    return np.asarray(pairs[(pairs >= 0).all(axis=1)])


def sparse_blocks(blocks: FloatArray, shared: Any) -> Any:
    """(3n, 3n) sparse ``kron(S, 1) + diag(B_1 .. B_n)``, axes of a point side by side.

    :param blocks: (n, 3, 3) B, what mixes the axes of each point
    :param shared: (n, n) sparse S, the same for each axis
    """
    from scipy.sparse import bsr_array, eye_array, kron

    points = np.arange(len(blocks))
    diagonal = bsr_array((blocks, points, np.arange(len(blocks) + 1)), shape=(3 * len(blocks), 3 * len(blocks)))
    return kron(shared, eye_array(3), format="csc") + diagonal.tocsc()


class BlockSystem:
    """``A x = b`` of ``sum_m w_m |r_m + J_m x|^2``, gathered group by group: ``A = sum w J^T J``, ``b = -sum w J^T r``.

    In 3 x 3 blocks of points and of pairs of points, sums of small dense products: no Jacobian of all rows is made.

    :param count: points
    :param links: (p,) ascending ``lower * count + higher`` of pairs of points with blocks
    """

    def __init__(self, count: int, links: IntArray) -> None:
        self._links = links
        self.diagonal = np.zeros((count, 3, 3))
        self.between = np.zeros((len(links), 3, 3))  # rows of the lower point
        self.right = np.zeros((count, 3))

    def matrix(self, shared: Any) -> Any:
        """A (3n, 3n) sparse, with `shared` (n, n) sparse for each axis on top."""
        from scipy.sparse import coo_array

        count = len(self.diagonal)
        low, high = np.divmod(self._links, max(count, 1))
        axes = np.arange(3)
        rows = np.broadcast_to(3 * low[:, None, None] + axes[:, None], self.between.shape)
        columns = np.broadcast_to(3 * high[:, None, None] + axes, self.between.shape)
        entries = (self.between.ravel(), (rows.ravel(), columns.ravel()))
        above = coo_array(entries, shape=(3 * count, 3 * count)).tocsc()
        return sparse_blocks(self.diagonal, shared) + above + above.T

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
            _gather(self.diagonal, points, squares[:, member, :, member])
            _gather(self.right, points, -right[:, member])
        for at, (first, second) in zip(groups.between, combinations(range(members), 2), strict=True):
            block = squares[:, first, :, second]
            turned = (groups.points[:, first] > groups.points[:, second])[:, None, None]
            _gather(self.between, at, np.where(turned, block.transpose(0, 2, 1), block))


def _gather(into: FloatArray, at: IntArray, values: FloatArray) -> None:
    """Add rows of `values` to rows of `into`; those at -1 or past the end go nowhere."""
    count = len(into)
    flat = into.reshape(count, -1)
    place = np.where(at < 0, count, at)
    # np.add.at takes three times as long
    for column, numbers in enumerate(values.reshape(len(values), -1).T):
        flat[:, column] += np.bincount(place, numbers, minlength=count + 1)[:count]
