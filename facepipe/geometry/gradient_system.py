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
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.factor import Factor, Solver, elimination_order, factorise
from facepipe.geometry.polygons import components, distinct_edges

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

    points: IntArray  # (p,) into all points, in the order in which bi-Laplacians of some of them are factored
    columns: IntArray  # (c,) the edges and, counted on, the bridges
    divergence: Any  # (p, c) sparse: transposed incidence times weights
    laplacian: Any  # (p, p) sparse: the divergence of the points' own differences
    component: IntArray  # (p,) number of the connected component
    factor: Factor  # of the Laplacian

    @cached_property
    def square(self) -> Any:
        """(p, p) sparse: the bi-Laplacian, of which those of moving points are parts."""
        square = (self.laplacian @ self.laplacian).tocsr()
        square.sort_indices()
        return square


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
        component = components(len(main), edges)
        self.main = _block(edges, weights, bridges, main, component, solver, anchor)
        self.loose = _block(edges, weights, bridges, ~main, component, solver)

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(n, c) points whose differences come nearest to (e, c) edge and (b, c) bridge vectors, the anchor held.

        Bridge vectors go from the leader to the follower.
        """
        main, loose = self.main, self.loose
        points = np.empty((len(main.points) + len(loose.points), edge_vectors.shape[1]))
        points[main.points] = main.factor.solve(main.divergence @ edge_vectors[main.columns]) + anchored
        vectors = np.concatenate([edge_vectors, bridge_vectors + points[self.bridges.leaders]])
        points[loose.points] = loose.factor.solve(loose.divergence @ vectors[loose.columns])
        return points

    def moving(self, moving: BoolArray) -> MovingSystem:
        """The bi-Laplacian of the same edges where only the points of `moving` (n,) may differ from 0."""
        return MovingSystem(self, moving)


class MovingSystem:
    """Offsets from edge vectors of offsets: least squares over ``|L u - M^T W d|`` with u = 0 at static points.

    Where a component moves altogether its equations hold to the bit, as the neutral's do, and need no squares: nearly
    all loose parts of a head's shapes do. The main one then is held by its anchor.
    """

    def __init__(self, system: GradientSystem, moving: BoolArray) -> None:
        self._count = len(moving)
        self._parts: list[_Whole | _Held] = []
        for block in (system.main, system.loose):
            free = moving[block.points]
            whole = (np.bincount(block.component, ~free) == 0)[block.component]
            held = free & ~whole
            self._parts += [_Whole(block, whole, system.solver)] if whole.any() else []
            self._parts += [_Held(block, held, system.solver)] if held.any() else []
        self._pinned = bool(moving[system.main.points].all())
        self._columns = np.concatenate([np.zeros(0, np.int64), *(part.columns for part in self._parts)])
        self._is_edge = self._columns < len(system.edges)
        self.edges = self._columns[self._is_edge]
        self.bridges = self._columns[~self._is_edge] - len(system.edges)
        self._leaders = system.bridges.leaders[self.bridges]
        self.points = np.flatnonzero(moving)

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(p, c) offsets of `points`.

        :param edge_vectors: (q, c) those of `edges`; all others are 0
        :param bridge_vectors: (b, c) those of `bridges`, leader to follower; all others are 0
        :param anchored: (c,) offset of the anchor, ignored where not all of its component moves
        """
        offsets = np.zeros((self._count, edge_vectors.shape[1]))
        vectors = np.empty((len(self._columns), edge_vectors.shape[1]))
        vectors[self._is_edge], vectors[~self._is_edge] = edge_vectors, bridge_vectors
        start = 0
        for part in self._parts:
            offsets[part.points] = part.solve(vectors[start : start + len(part.columns)])
            if not start:  # the main component, which all bridges lead from; none leads to it
                offsets[part.points] += anchored if self._pinned else 0.0
                vectors[~self._is_edge] += offsets[self._leaders]
            start += len(part.columns)
        return offsets[self.points]

    def compliance(self, points: IntArray) -> FloatArray:
        """(p, m) how far each of the moving points, all of the main component, goes with a unit force on each of
        `points` (m,).

        Columns of the inverse of the bi-Laplacian, which is the same for all three coordinates.
        """
        (main,) = self._parts
        ascending = np.argsort(main.points)
        units = np.zeros((len(ascending), len(points)))
        units[ascending[np.searchsorted(main.points, points, sorter=ascending)], np.arange(len(points))] = 1.0
        return main.factor.solve(units)[ascending]


class _Whole:
    """The components of a block that move altogether; with a factor of their own, as most shapes move few."""

    def __init__(self, block: _Block, chosen: BoolArray, solver: Solver) -> None:
        rows = np.flatnonzero(chosen)
        divergence = block.divergence[rows]
        touched = _used(divergence)
        self.points, self.columns = block.points[rows], block.columns[touched]
        self._divergence = divergence[:, touched]
        own = block.laplacian[rows][:, rows].T
        self.factor = block.factor if chosen.all() else factorise(own, solver, ordered=True)

    def solve(self, vectors: FloatArray) -> FloatArray:
        return self.factor.solve(self._divergence @ vectors)


class _Held:
    """Points of a block whose components are held at their static points."""

    def __init__(self, block: _Block, chosen: BoolArray, solver: Solver) -> None:
        columns = np.flatnonzero(chosen)
        equations = block.laplacian[columns]  # symmetric: rows are columns
        rows = _used(equations)  # equations that the moving points have a part in
        self._equations = equations[:, rows]
        divergence = block.divergence[rows]
        touched = _used(divergence)
        self.points, self.columns = block.points[columns], block.columns[touched]
        self._divergence = divergence[:, touched]
        self.factor: Factor = factorise(block.square[columns][:, columns].T, solver, ordered=True)

    def solve(self, vectors: FloatArray) -> FloatArray:
        return self.factor.solve(self._equations @ (self._divergence @ vectors))


class _Anchored:
    """The factor of a connected component's Laplacian, one point of which stays at 0."""

    def __init__(self, laplacian: Any, anchor: int, solver: Solver) -> None:
        self._free = np.delete(np.arange(laplacian.shape[0]), anchor)
        self._factor = factorise(laplacian[self._free][:, self._free], solver)

    def solve(self, right: FloatArray) -> FloatArray:
        solution = np.zeros_like(right)
        solution[self._free] = self._factor.solve(right[self._free])
        return solution


def _used(matrix: Any) -> IntArray:
    """The columns of a compressed-row matrix that have entries, ascending."""
    used = np.zeros(matrix.shape[1], dtype=bool)
    used[matrix.indices] = True
    return np.flatnonzero(used)


def _block(
    edges: IntArray,
    weights: FloatArray,
    bridges: Bridges,
    inside: BoolArray,
    component: IntArray,
    solver: Solver,
    anchor: int | None = None,
) -> _Block:
    """The block of the points `inside`; bridges end in their followers alone, leaders are given.

    :param component: (n,) number of every point's connected component
    :param anchor: the point that stays at 0
    """
    from scipy.sparse import csr_array, vstack

    points, rows = np.flatnonzero(inside), np.flatnonzero(inside[edges[:, 0]])
    across = np.flatnonzero(inside[bridges.followers])
    own_edges, followers = np.searchsorted(points, edges[rows]), np.searchsorted(points, bridges.followers[across])
    bridged = (np.ones(len(across)), (np.arange(len(across)), followers))
    gradient = vstack([incidence(own_edges, len(points)), csr_array(bridged, shape=(len(across), len(points)))]).tocsr()
    divergence = gradient.T.multiply(np.concatenate([weights[rows], bridges.weights[across]])[None]).tocsr()
    laplacian = (divergence @ gradient).tocsr()
    order = elimination_order(laplacian)
    points, laplacian = points[order], laplacian[order][:, order]
    held = None if anchor is None else int(np.flatnonzero(points == anchor)[0])
    return _Block(
        points=points,
        columns=np.concatenate([rows, len(edges) + across]),
        divergence=divergence[order],
        laplacian=laplacian,
        component=np.unique(component[points], return_inverse=True)[1].ravel(),
        factor=factorise(laplacian, solver) if held is None else _Anchored(laplacian, held, solver),
    )
