"""Expressions: the offsets of one sculpt, solved from the blended differences of the sources' offsets."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.geometry.gradient_system import GradientSystem
from facepipe.processors.blend.kept_parts import KeptParts
from facepipe.processors.blend.mixing import Shared, mix
from facepipe.processors.blend.network import Network
from facepipe.processors.blend.sculpts import Sculpt

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]


class Expression:
    """A sculpt ready to be solved for any weights.

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
        self._held = system.moving(self._moving) if hold_static else None
        bridges = network.bridges
        self.edges = self._held.edges if self._held else _touching(self._moving, network.edges)
        self.bridges = self._held.bridges if self._held else np.arange(len(bridges.followers))
        ends = network.edges[self.edges]
        self.edge_vectors = self._vectors(ends[:, 0], ends[:, 1])  # (K, q, 3) of offsets
        self._bridge_vectors = self._vectors(bridges.leaders[self.bridges], bridges.followers[self.bridges])

    def solve(self, shared: Shared) -> FloatArray:
        """(u, 3) offsets of the sculpt's points."""
        network, points = self._network, self.sculpt.points
        bridges = network.bridges
        along = shared.between(bridges.leaders[self.bridges], bridges.followers[self.bridges])
        wanted, bridged = self.wanted(shared), mix(along, self._bridge_vectors)
        anchored = self._anchored(shared.shares)
        offsets = np.zeros((len(self._moving), 3))
        if self._held:
            offsets[self._held.points] = self._held.solve(wanted, bridged, anchored)
            offsets[network.anchor] = anchored
        else:
            everywhere = np.zeros((len(network.edges), 3))
            everywhere[self.edges] = wanted
            offsets[points] = self._system.solve(everywhere, bridged, anchored)[points]
        self._kept.fit_moved(shared.points, offsets, self._moving)
        return offsets[points]

    def wanted(self, shared: Shared) -> FloatArray:
        """(q, 3) blended vectors of the offsets along `edges`."""
        return mix(shared.edge_shares[self.edges], self.edge_vectors)

    def _anchored(self, shares: FloatArray) -> FloatArray:
        anchor = self._network.anchor
        if not self._moving[anchor]:
            return np.zeros(3)
        own = self.sculpt.offsets[:, np.searchsorted(self.sculpt.points, anchor)]
        return np.asarray(shares[anchor] @ own)

    def _vectors(self, start: IntArray, end: IntArray) -> FloatArray:
        place = np.full(len(self._moving), len(self.sculpt.points))  # static points: a row of zeros at the end
        place[self.sculpt.points] = np.arange(len(self.sculpt.points))
        padded = np.concatenate([self.sculpt.offsets, np.zeros((len(self.sculpt.offsets), 1, 3))], axis=1)
        return np.asarray(padded[:, place[end]] - padded[:, place[start]])


def _touching(moving: npt.NDArray[np.bool_], edges: IntArray) -> IntArray:
    return np.flatnonzero(moving[edges].any(axis=1))
