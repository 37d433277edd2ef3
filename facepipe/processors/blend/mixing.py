"""Values of the sources mixed by their shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Shares of the K sources over n points and e edges, and the neutral solved with them, in the base's bind space."""

    shares: FloatArray  # (n, K) of every point
    edge_shares: FloatArray  # (e, K) of every edge: the mean of its ends'
    points: FloatArray  # (n, 3)

    def between(self, first: IntArray, second: IntArray) -> FloatArray:
        """(b, K) shares of edges between points: the mean of their ends'."""
        return mean_of_ends(self.shares, first, second)


def mean_of_ends(shares: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """(b, K) means of the shares (n, K) of two points each."""
    return np.asarray(0.5 * (shares[first] + shares[second]))


def mix(shares: FloatArray, values: FloatArray) -> FloatArray:
    """(r, c) sums of (K, r, c) values under (r, K) shares."""
    return np.asarray(np.einsum("rk,krc->rc", shares, values))
