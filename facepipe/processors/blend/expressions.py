"""Expressions: the offsets of one sculpt, solved from the blended differences of the sources' offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.gradient_system import GradientSystem, MovingSystem
from facepipe.processors.blend.kept_parts import KeptParts
from facepipe.processors.blend.mixing import Shared, mix
from facepipe.processors.blend.network import Network
from facepipe.processors.blend.sculpts import Sculpt


class Expression:
    """A sculpt solved for any weights; what that takes is factored at the first solve, and kept until `release`.

    An expression's edge vectors are the neutral's plus those of its offsets, and the solve is linear: so only the
    offsets are solved for, and they vanish where nothing moves.

    :param hold_static: points that move in no source are held at 0 inside the bi-Laplacian solve; otherwise, as in the
        document (S605', S606'), all points are solved and static ones put back after it
    """

    def __init__(
        self, sculpt: Sculpt, network: Network, system: GradientSystem, kept: KeptParts, *, hold_static: bool
    ) -> None:
        self.sculpt, self._network, self._system, self._kept = sculpt, network, system, kept
        self._moving = np.zeros(len(network.component), dtype=bool)
        self._moving[sculpt.points] = True
        self._hold_static = hold_static
        self._rigid = kept.rigid_in(sculpt, self._moving)
        self._prepared: _Prepared | None = None

    def solve(self, shared: Shared) -> FloatArray:
        """(u, 3) offsets of the sculpt's points."""
        if self._prepared is None:
            self._prepared = self._prepare()
        prepared, network, points = self._prepared, self._network, self.sculpt.points
        bridges = network.bridges
        along = shared.between(bridges.leaders[prepared.bridges], bridges.followers[prepared.bridges])
        wanted = mix(shared.edge_shares[prepared.edges], prepared.edge_vectors)
        bridged, anchored = mix(along, prepared.bridge_vectors), self._anchored(shared.shares)
        offsets = np.zeros((len(self._moving), 3))
        if prepared.held:
            offsets[prepared.held.points] = prepared.held.solve(wanted, bridged, anchored)
            if prepared.held.pinned:
                offsets[network.anchor] = anchored
        else:
            everywhere = np.zeros((len(network.edges), 3))
            everywhere[prepared.edges] = wanted
            offsets[points] = self._system.solve(everywhere, bridged, anchored)[points]
        self._kept.fit_moved(shared.points, offsets, self._rigid, self._moving)
        return offsets[points]

    def release(self) -> None:
        """Give the memory of the factor back; the next solve factors again."""
        self._prepared = None

    def asked(self, shared: Shared) -> tuple[IntArray, FloatArray]:
        """Edges (q,) at moving points, and the blended vectors (q, 3) of the offsets that are asked of them."""
        touching = np.flatnonzero(self._moving[self._network.edges].any(axis=1))
        ends = self._network.edges[touching]
        return touching, mix(shared.edge_shares[touching], self._vectors(ends[:, 0], ends[:, 1]))

    def _prepare(self) -> _Prepared:
        network, bridges = self._network, self._network.bridges
        held = self._system.moving(self._moving) if self._hold_static else None
        edges = held.edges if held else np.flatnonzero(self._moving[network.edges].any(axis=1))
        across = held.bridges if held else np.arange(len(bridges.followers))
        ends = network.edges[edges]
        return _Prepared(
            held=held,
            edges=edges,
            bridges=across,
            edge_vectors=self._vectors(ends[:, 0], ends[:, 1]),
            bridge_vectors=self._vectors(bridges.leaders[across], bridges.followers[across]),
        )

    def _anchored(self, shares: FloatArray) -> FloatArray:
        anchor = self._network.anchor
        if not self._moving[anchor]:
            return np.zeros(3)
        own = self.sculpt.offsets[:, np.searchsorted(self.sculpt.points, anchor)]
        return np.asarray(shares[anchor] @ own)

    def _vectors(self, start: IntArray, end: IntArray) -> FloatArray:
        """(K, q, 3) vectors of the sources' offsets from points to points."""
        place = np.full(len(self._moving), len(self.sculpt.points))  # static points: a row of zeros at the end
        place[self.sculpt.points] = np.arange(len(self.sculpt.points))
        padded = np.concatenate([self.sculpt.offsets, np.zeros((len(self.sculpt.offsets), 1, 3))], axis=1)
        return np.asarray(padded[:, place[end]] - padded[:, place[start]])


@dataclass(frozen=True)
class _Prepared:
    """The factor of one sculpt, and its right-hand sides before they are mixed."""

    held: MovingSystem | None  # None: the neutral's own system is solved
    edges: IntArray  # (q,)
    bridges: IntArray  # (b,)
    edge_vectors: FloatArray  # (K, q, 3) of offsets
    bridge_vectors: FloatArray  # (K, b, 3)
