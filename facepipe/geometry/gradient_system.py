"""Differences along edges, points from edge vectors: ``M^T W M x = M^T W D`` with an anchor, and the bi-Laplacian.

Source: the gradient-domain face blending document, S602-S605'. Its rows of M hold 1 at both ends of an edge; such an
M can't satisfy ``M x = D``, so here they hold -1 and +1. Multiplying both sides by M^T M once more (S605') leaves the
solution as it is, since M^T D lies in the range of M^T M; it differs once points are held, and that is what
`GradientSystem.moving` solves.

Real heads have dozens of connected components (eyeballs, every tooth, lashes), and edge vectors say nothing about where
a loose one lies. So the main component, which holds the anchor, is solved first; each point of a loose one follows the
nearest point of it over a bridge edge, each joint the points around it, and they never pull at the face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.factor import Factor, Solver, factorise
from facepipe.geometry.polygons import distinct_edges

SMALLEST_COTANGENT = 0.05  # obtuse and flat triangles: weights stay positive, so that a face keeps one solution
LARGEST_COTANGENT = 20.0
_FLATTEST_TANGENT = 1e-15  # tangent of the smallest angle that is not 0
_JOINT_REACH = 1.5  # a joint's bridges go to the points up to this many times as far as the nearest one
_JOINT_BRIDGES = 256  # at most, the nearest ones
_TIES_SEEN = 8  # points looked at for being equally near
_EQUAL_DISTANCE = 1e-9  # distances that differ by less are equal


def incidence(edges: IntArray, point_count: int) -> Any:
    """(e, n) sparse signed incidence matrix of (e, 2) edges."""
    from scipy.sparse import csr_array

    rows = np.repeat(np.arange(len(edges)), 2)
    signs = np.tile([-1.0, 1.0], len(edges))
    return csr_array((signs, (rows, np.asarray(edges).ravel())), shape=(len(edges), point_count))


def edge_vectors(points: FloatArray, edges: IntArray) -> FloatArray:
    """(..., e, 3) vectors from the first to the second end of (e, 2) edges, of points (..., n, 3)."""
    return np.asarray(points.take(edges[:, 1], axis=-2) - points.take(edges[:, 0], axis=-2))


def cotangent_weights(points: FloatArray, triangles: IntArray) -> tuple[IntArray, FloatArray]:
    """Edges (e, 2) of the triangles, lower point first, and their weights (e,): half the sum of the cotangents of the
    angles opposite (Pinkall & Polthier 1993), kept between `SMALLEST_COTANGENT` and `LARGEST_COTANGENT`.
    """
    corners = points[triangles]
    pairs, cotangents = [], []
    for apex in range(3):
        a, b = corners[:, (apex + 1) % 3] - corners[:, apex], corners[:, (apex + 2) % 3] - corners[:, apex]
        doubled_area = np.linalg.norm(np.cross(a, b), axis=1)
        along = (a * b).sum(axis=1)
        least = np.maximum(
            _FLATTEST_TANGENT * np.abs(along), np.finfo(np.float64).tiny
        )  # a sum of cotangents stays finite
        cotangents.append(0.5 * along / np.maximum(doubled_area, least))
        pairs.append(triangles[:, [(apex + 1) % 3, (apex + 2) % 3]])
    edges, edge, _ = distinct_edges(np.concatenate(pairs))
    weights = np.bincount(edge, np.concatenate(cotangents), minlength=len(edges))
    return edges, np.clip(weights, SMALLEST_COTANGENT, LARGEST_COTANGENT)


@dataclass(frozen=True)
class Bridges:
    """Edges from followers to leaders, and their weights: followers move with leaders, never the other way."""

    followers: IntArray  # (b,)
    leaders: IntArray  # (b,) points
    weights: FloatArray  # (b,) above 0


def part_bridges(points: FloatArray, component: IntArray, main: int) -> Bridges:
    """Bridges from every one of `points` (n, 3) outside component number `main` to the nearest point in it.

    The weight is ``1 / (1 + (d / median)^2)``, by the median distance of the same component: where a part touches the
    face it follows the face.
    """
    from scipy.spatial import cKDTree

    inside = np.flatnonzero(component == main)
    loose = np.flatnonzero(component != main)
    if not len(loose):
        return Bridges(loose, loose, np.zeros(0))
    distances, nearest = cKDTree(points[inside]).query(points[loose], k=np.arange(1, min(_TIES_SEEN, len(inside)) + 1))
    distance = distances[:, 0]
    # the first of those that are equally near, which rounding (other units, axes or places) would choose among
    tied = distances <= distance[:, None] * (1.0 + _EQUAL_DISTANCE)
    leaders = np.where(tied, inside[nearest], len(points)).min(axis=1)
    group = component[loose]
    # (n,) median of each value's group; 1 where that is 0
    numbers, place, counts = np.unique(group, return_inverse=True, return_counts=True)
    order = np.lexsort((distance, place))
    ends = np.cumsum(counts)
    medians = distance[order][ends - counts + counts // 2] if len(numbers) else np.zeros(0)
    reach = np.asarray(np.where(medians > 0, medians, 1.0)[place])
    return Bridges(loose, leaders, 1.0 / (1.0 + (distance / reach) ** 2))


def joint_bridges(points: FloatArray, joints: FloatArray) -> Bridges:
    """Bridges from every joint (j, 3) to the points around it; the joints' numbers are the followers."""
    from scipy.spatial import cKDTree

    count = min(_JOINT_BRIDGES, len(points))
    if not count or not len(joints):
        return Bridges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    distances, nearest = cKDTree(points).query(joints, k=np.arange(1, count + 1))
    reach = _JOINT_REACH * np.maximum(distances[:, :1], np.finfo(np.float64).tiny)
    near = distances <= reach * (1.0 + _EQUAL_DISTANCE)
    followers = np.repeat(np.arange(len(joints)), near.sum(axis=1))
    weights = 1.0 / (1.0 + np.divide(distances, reach, out=np.zeros_like(distances), where=near) ** 2)
    return Bridges(followers, nearest[near], weights[near])


@dataclass(frozen=True)
class _Block:
    """One of the two solves: its points, and what the edges and bridges that end in them give them."""

    points: IntArray  # (p,) into all points
    divergence: Any  # (p, e + b) sparse: transposed incidence times weights; columns: all edges, then all bridges
    laplacian: Any  # (p, p) sparse: the divergence of the points' own differences
    component: IntArray  # (p,) number of the connected component


class GradientSystem:
    """The factored system of one topology.

    :param edges: (e, 2) edges over all components
    :param weights: (e,) above 0
    :param main: (n,) points of the component that holds the anchor
    :param bridges: from every loose component to the main one
    :param anchor: the point of the main component that is held
    """

    def __init__(
        self,
        edges: IntArray,
        weights: FloatArray,
        main: BoolArray,
        bridges: Bridges,
        anchor: int,
        solver: Solver = "splu",
    ) -> None:
        self.edges, self.bridges, self.anchor, self.solver = edges, bridges, anchor, solver
        nothing = Bridges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
        self._main = _block(edges, weights, nothing, main)
        self._loose = _block(edges, weights, bridges, ~main)
        self._anchor = int(np.searchsorted(self._main.points, anchor))
        free = np.delete(np.arange(len(self._main.points)), self._anchor)
        self._to_anchor = self._main.laplacian[free][:, [self._anchor]].tocsr()
        self._main_factor = factorise(self._main.laplacian[free][:, free], solver)
        self._loose_factor = factorise(self._loose.laplacian, solver)

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(n, c) points whose differences come nearest to (e, c) edge and (b, c) bridge vectors, the anchor held.

        Bridge vectors go from the leader to the follower.
        """
        points = np.empty((len(self._main.points) + len(self._loose.points), edge_vectors.shape[1]))
        right = np.delete(self._main.divergence @ edge_vectors, self._anchor, axis=0)
        solved = self._main_factor.solve(right - self._to_anchor @ anchored[None])
        points[self._main.points] = np.insert(solved, self._anchor, anchored, axis=0)
        vectors = np.concatenate([edge_vectors, bridge_vectors + points[self.bridges.leaders]])
        points[self._loose.points] = self._loose_factor.solve(self._loose.divergence @ vectors)
        return points

    def moving(self, moving: BoolArray) -> MovingSystem:
        """The bi-Laplacian of the same edges where only the points of `moving` (n,) may differ from 0."""
        return MovingSystem(self, moving)


class MovingSystem:
    """Offsets from edge vectors of offsets: least squares over ``|L u - M^T W d|`` with u = 0 at static points.

    Where all of the main component moves, only the anchor holds it: it is `pinned`, and its offset must be given.
    """

    def __init__(self, system: GradientSystem, moving: BoolArray) -> None:
        self._anchor, edge_count = system._anchor, len(system.edges)
        self.pinned = bool(moving[system._main.points].all())
        held = self._anchor if self.pinned else None
        self._main = _Held(system._main, moving, edge_count, system.solver, held)
        self._loose = _Held(system._loose, moving, edge_count, system.solver)
        self.edges = np.concatenate([self._main.edges, self._loose.edges])
        self.bridges = self._loose.bridges
        self.points = np.concatenate([self._main.points, self._loose.points])
        self._main_count = len(system._main.points)
        self._leaders = np.searchsorted(system._main.points, system.bridges.leaders[self.bridges])

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(p, c) offsets of `points`.

        :param edge_vectors: (q, c) those of `edges`; all others are 0
        :param bridge_vectors: (b, c) those of `bridges`, leader to follower; all others are 0
        :param anchored: (c,) offset of the anchor, ignored where it is not pinned
        """
        count = len(self._main.edges)
        main = self._main.solve(edge_vectors[:count], anchored)
        moved = np.zeros((self._main_count, edge_vectors.shape[1]))
        moved[self._main.columns] = main
        if self.pinned:
            moved[self._anchor] = anchored
        loose = self._loose.solve(np.concatenate([edge_vectors[count:], bridge_vectors + moved[self._leaders]]))
        return np.concatenate([main, loose])

    def compliance(self, points: IntArray) -> FloatArray:
        """(p, m) how far each of the main component's moving points goes with a unit force on each of `points` (m,).

        Columns of the inverse of the bi-Laplacian, which is the same for all three coordinates.
        """
        units = np.zeros((len(self._main.points), len(points)))
        units[np.searchsorted(self._main.points, points), np.arange(len(points))] = 1.0
        return self._main.factored(units)


class _Held:
    """One block of a moving system."""

    def __init__(
        self, block: _Block, moving: BoolArray, edge_count: int, solver: Solver, held: int | None = None
    ) -> None:
        free = moving[block.points].copy()
        if held is not None:
            free[held] = False
        self.columns = np.flatnonzero(free)
        self.points = block.points[self.columns]
        equations = block.laplacian[self.columns]  # symmetric: rows are columns
        rows = _used(equations)  # equations that the moving points have a part in
        squeezed = equations[:, rows].tocsr()
        # Where a component moves altogether its equations hold to the bit, and need no squares: loose parts of a head's
        # shapes then take a third of the time. All but a held point do so too.
        moved = np.bincount(block.component[self.columns], minlength=len(block.points))
        whole = (moved == np.bincount(block.component, minlength=len(block.points)))[block.component[self.columns]]
        self._tested = _with_units(squeezed, np.searchsorted(rows, self.columns), whole | (held is not None))
        divergence = block.divergence[rows]
        touched = _used(divergence)
        self.edges, self.bridges = touched[touched < edge_count], touched[touched >= edge_count] - edge_count
        self._divergence = divergence[:, touched].tocsr()
        self._given = None if held is None else block.laplacian[rows][:, [held]].tocsr()
        self._factor: Factor = factorise(self._tested @ squeezed.T, solver)

    def solve(self, vectors: FloatArray, anchored: FloatArray | None = None) -> FloatArray:
        right = self._divergence @ vectors
        if self._given is not None and anchored is not None and anchored.any():
            right = right - self._given @ anchored[None]
        return self._factor.solve(self._tested @ right)

    def factored(self, right: FloatArray) -> FloatArray:
        """(p, m) solutions of the bi-Laplacian itself."""
        return self._factor.solve(right)


def _with_units(matrix: Any, places: IntArray, chosen: BoolArray) -> Any:
    """A sparse matrix (p, r) whose `chosen` rows (p,) have but a 1, each at its place (p,)."""
    from scipy.sparse import csr_array

    if not chosen.any():
        return matrix
    count = len(places)
    units = csr_array((chosen.astype(np.float64), places, np.arange(count + 1)), shape=matrix.shape)
    kept = csr_array(
        (matrix.data * np.repeat(~chosen, np.diff(matrix.indptr)), matrix.indices, matrix.indptr), matrix.shape
    )
    return kept + units


def _used(matrix: Any) -> IntArray:
    """The columns of a compressed-row matrix that have entries, ascending."""
    used = np.zeros(matrix.shape[1], dtype=bool)
    used[matrix.indices] = True
    return np.flatnonzero(used)


def _block(edges: IntArray, weights: FloatArray, bridges: Bridges, inside: BoolArray) -> _Block:
    """The block of the points `inside`; bridges end in their followers alone, leaders are given."""
    from scipy.sparse import csr_array, vstack
    from scipy.sparse.csgraph import connected_components

    points, rows, count = np.flatnonzero(inside), np.flatnonzero(inside[edges[:, 0]]), len(bridges.followers)
    inner = incidence(np.searchsorted(points, edges[rows]), len(points))
    followers = np.searchsorted(points, bridges.followers)
    ends = csr_array((np.ones(count), (np.arange(count), followers)), shape=(count, len(points)))
    gradient = vstack([inner, ends]).tocsr()
    row_weights = np.concatenate([weights[rows], bridges.weights])
    divergence = gradient.T.multiply(row_weights[None]).tocsr()
    columns = np.concatenate([rows, len(edges) + np.arange(count)])
    laplacian = (divergence @ gradient).tocsr()
    everywhere = (divergence.data, columns[divergence.indices], divergence.indptr)
    return _Block(
        points=points,
        divergence=csr_array(everywhere, shape=(len(points), len(edges) + count)),
        laplacian=laplacian,
        component=connected_components(laplacian, directed=False)[1],
    )
