"""Points from edge vectors: ``M^T W M x = M^T W D`` with an anchor, and the bi-Laplacian with static points.

Source: the gradient-domain face blending document, S602-S605'. Its rows of M hold 1 at both ends of an edge; such an
M can't satisfy ``M x = D``, so here they hold -1 and +1. Multiplying both sides by M^T M once more (S605') leaves the
solution as it is, since M^T D lies in the range of M^T M; it differs once points are held, and that is what
`GradientSystem.moving` solves.

The main component, which holds the anchor, is solved first; loose components follow it over bridges, so that they
never pull at the face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.bridges import Bridges
from facepipe.geometry.differences import incidence
from facepipe.geometry.factor import Factor, Solver, factorise

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Block:
    """One of the two solves: its points, and what the edges and bridges that end in them give them."""

    points: IntArray  # (p,) into all points
    divergence: Any  # (p, e + b) sparse: transposed incidence times weights; columns: all edges, then all bridges
    laplacian: Any  # (p, p) sparse: the divergence of the points' own differences


class GradientSystem:
    """The factored system of one topology.

    :param edges: (e, 2) edges over all components
    :param weights: (e,) above 0
    :param main: (n,) points of the component that holds the anchor
    :param bridges: from every loose component to the main one
    :param anchor: the point of the main component that is held
    """

    def __init__(
        self, edges: IntArray, weights: FloatArray, main: Mask, bridges: Bridges, anchor: int, solver: Solver = "auto"
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

    def moving(self, moving: Mask) -> MovingSystem:
        """The bi-Laplacian of the same edges where only the points of `moving` (n,) may differ from 0."""
        return MovingSystem(self, moving)


class MovingSystem:
    """Offsets from edge vectors of offsets: least squares over ``|L u - M^T W d|`` with u = 0 at static points.

    Where all of the main component moves, only the anchor holds it: it is `pinned`, and its offset must be given.
    """

    def __init__(self, system: GradientSystem, moving: Mask) -> None:
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
        :param anchored: (c,) offset of the anchor, of no matter where it is not pinned
        """
        count = len(self._main.edges)
        main = self._main.solve(edge_vectors[:count], anchored)
        moved = np.zeros((self._main_count, edge_vectors.shape[1]))
        moved[self._main.columns] = main
        if self.pinned:
            moved[self._anchor] = anchored
        loose = self._loose.solve(np.concatenate([edge_vectors[count:], bridge_vectors + moved[self._leaders]]))
        return np.concatenate([main, loose])


class _Held:
    """One block of a moving system."""

    def __init__(self, block: _Block, moving: Mask, edge_count: int, solver: Solver, held: int | None = None) -> None:
        free = moving[block.points].copy()
        if held is not None:
            free[held] = False
        self.columns = np.flatnonzero(free)
        self.points = block.points[self.columns]
        equations = block.laplacian[self.columns]  # symmetric: rows are columns
        rows = _used(equations)  # equations that the moving points have a part in
        self._squeezed = equations[:, rows].tocsr()
        divergence = block.divergence[rows]
        touched = _used(divergence)
        self.edges, self.bridges = touched[touched < edge_count], touched[touched >= edge_count] - edge_count
        self._divergence = divergence[:, touched].tocsr()
        self._given = None if held is None else block.laplacian[rows][:, [held]].tocsr()
        self._factor: Factor = factorise(self._squeezed @ self._squeezed.T, solver)

    def solve(self, vectors: FloatArray, anchored: FloatArray | None = None) -> FloatArray:
        right = self._divergence @ vectors
        if self._given is not None and anchored is not None and anchored.any():
            right = right - self._given @ anchored[None]
        return self._factor.solve(self._squeezed @ right)


def _used(matrix: Any) -> IntArray:
    """The columns of a compressed-row matrix that have entries, ascending."""
    used = np.zeros(matrix.shape[1], dtype=bool)
    used[matrix.indices] = True
    return np.flatnonzero(used)


def _block(edges: IntArray, weights: FloatArray, bridges: Bridges, inside: Mask) -> _Block:
    """The block of the points `inside`; bridges end in their followers alone, leaders are given."""
    from scipy.sparse import csr_array, vstack

    points, rows, count = np.flatnonzero(inside), np.flatnonzero(inside[edges[:, 0]]), len(bridges.followers)
    inner = incidence(np.searchsorted(points, edges[rows]), len(points))
    followers = np.searchsorted(points, bridges.followers)
    ends = csr_array((np.ones(count), (np.arange(count), followers)), shape=(count, len(points)))
    gradient = vstack([inner, ends]).tocsr()
    row_weights = np.concatenate([weights[rows], bridges.weights])
    divergence = gradient.T.multiply(row_weights[None]).tocsr()
    columns = np.concatenate([rows, len(edges) + np.arange(count)])
    everywhere = (divergence.data, columns[divergence.indices], divergence.indptr)
    return _Block(
        points=points,
        divergence=csr_array(everywhere, shape=(len(points), len(edges) + count)),
        laplacian=(divergence @ gradient).tocsr(),
    )
