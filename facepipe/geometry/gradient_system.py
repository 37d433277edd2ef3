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

from facepipe.geometry.bridges import Bridges
from facepipe.geometry.differences import incidence
from facepipe.geometry.factor import Factor, Solver, factorise

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Block:
    """One of the two solves: its points, and the rows (edges, then bridges) that end in them."""

    points: IntArray  # (p,) into all points
    edges: IntArray  # (q,) rows, into all edges
    bridges: IntArray  # (b,) rows, into all bridges
    gradient: Any  # (q + b, p) sparse: incidence of the block's own points
    divergence: Any  # (p, q + b) sparse: its transpose times the weights
    laplacian: Any  # (p, p) sparse


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
        rows = np.flatnonzero(main[edges[:, 0]])
        self._main = _block(edges, weights, bridges, np.flatnonzero(main), rows, np.zeros(0, np.int64))
        rest = np.flatnonzero(~main[edges[:, 0]])
        self._loose = _block(edges, weights, bridges, np.flatnonzero(~main), rest, np.arange(len(bridges.followers)))
        self._anchor = int(np.searchsorted(self._main.points, anchor))
        self._free = np.delete(np.arange(len(self._main.points)), self._anchor)
        self._main_factor = factorise(self._main.laplacian[self._free][:, self._free], solver)
        self._loose_factor = factorise(self._loose.laplacian, solver)

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(n, c) points whose differences come nearest to (e, c) edge and (b, c) bridge vectors, the anchor held.

        Bridge vectors go from the leader to the follower.
        """
        points = np.empty((len(self._main.points) + len(self._loose.points), edge_vectors.shape[1]))
        right = self._main.divergence @ edge_vectors[self._main.edges]
        right -= self._main.laplacian[:, [self._anchor]] @ anchored[None]
        own = np.empty((len(right), right.shape[1]))
        own[self._free] = self._main_factor.solve(right[self._free])
        own[self._anchor] = anchored
        points[self._main.points] = own
        points[self._loose.points] = self._loose_factor.solve(
            self._loose_right(edge_vectors, bridge_vectors, points[self.bridges.leaders])
        )
        return points

    def _loose_right(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, leaders: FloatArray) -> FloatArray:
        vectors = np.concatenate([edge_vectors[self._loose.edges], bridge_vectors + leaders])
        return np.asarray(self._loose.divergence @ vectors)

    def moving(self, moving: Mask) -> MovingSystem:
        """The bi-Laplacian of the same edges where only the points of `moving` (n,) may differ from 0."""
        return MovingSystem(self, moving)


class MovingSystem:
    """Offsets from edge vectors of offsets: least squares over ``|L u - M^T W d|`` with u = 0 at static points."""

    def __init__(self, system: GradientSystem, moving: Mask) -> None:
        self._system = system
        self._main = _Held(system._main, moving, system.solver, given=system._anchor)
        self._loose = _Held(system._loose, moving, system.solver)
        self.edges = np.concatenate([self._main.edges, self._loose.edges])
        self.bridges = self._loose.bridges
        self.points = np.concatenate([self._main.points, self._loose.points])

    def solve(self, edge_vectors: FloatArray, bridge_vectors: FloatArray, anchored: FloatArray) -> FloatArray:
        """(p, c) offsets of `points`.

        :param edge_vectors: (q, c) those of `edges`; all others are 0
        :param bridge_vectors: (b, c) those of `bridges`, leader to follower; all others are 0
        :param anchored: (c,) offset of the anchor, 0 where it is static
        """
        count, leaders = len(self._main.edges), self._system.bridges.leaders[self.bridges]
        main = self._main.solve(edge_vectors[:count], anchored)
        moved = np.zeros((len(self._system._main.points), edge_vectors.shape[1]))
        moved[self._main.columns] = main
        moved[self._system._anchor] = anchored
        places = np.searchsorted(self._system._main.points, leaders)
        loose = self._loose.solve(np.concatenate([edge_vectors[count:], bridge_vectors + moved[places]]))
        return np.concatenate([main, loose])


class _Held:
    """One block of a moving system."""

    def __init__(self, block: _Block, moving: Mask, solver: Solver, given: int | None = None) -> None:
        free = moving[block.points].copy()
        if given is not None:
            free[given] = False
        self.columns = np.flatnonzero(free)
        self.points = block.points[self.columns]
        squeezed = block.laplacian[:, self.columns].tocsc()
        rows = np.unique(squeezed.indices)  # equations that the moving points have a part in
        self._squeezed = squeezed[rows].T.tocsr()
        touched = np.unique(block.divergence[rows].indices)
        own = touched[touched < len(block.edges)]
        self.edges = block.edges[own]
        self.bridges = block.bridges[touched[touched >= len(block.edges)] - len(block.edges)]
        self._divergence = block.divergence[rows][:, touched].tocsr()
        self._given = None if given is None else block.laplacian[rows][:, [given]].tocsr()
        self._factor: Factor = factorise(self._squeezed @ self._squeezed.T, solver)

    def solve(self, vectors: FloatArray, anchored: FloatArray | None = None) -> FloatArray:
        right = self._divergence @ vectors
        if self._given is not None and anchored is not None and anchored.any():
            right = right - self._given @ anchored[None]
        return self._factor.solve(self._squeezed @ right)


def _block(
    edges: IntArray, weights: FloatArray, bridges: Bridges, points: IntArray, rows: IntArray, bridge_rows: IntArray
) -> _Block:
    """The block of `points`; at bridges only the follower is a column, the leader is given."""
    from scipy.sparse import csr_array, vstack

    own = incidence(np.searchsorted(points, edges[rows]), len(points))
    count = len(bridge_rows)
    columns = np.searchsorted(points, bridges.followers[bridge_rows])
    ends = csr_array((np.ones(count), (np.arange(count), columns)), shape=(count, len(points)))
    gradient = vstack([own, ends]).tocsr()
    row_weights = np.concatenate([weights[rows], bridges.weights[bridge_rows]])
    divergence = gradient.T.multiply(row_weights[None]).tocsr()
    return _Block(points, rows, bridge_rows, gradient, divergence, (divergence @ gradient).tocsr())
