"""What of a scan counts in a fit: matches across a slit don't, far ones and wrong landmarks hardly."""

from __future__ import annotations

from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.geometry.closest_points import closest_places
from facepipe.geometry.differences import cotangent_weights
from facepipe.geometry.registration.target import Matches

_ANCHOR_OUTLIER = 4.0  # mm, and four times the median: further off, an anchor is told
_ANCHOR_BLUNDER = 25.0  # mm, and five times the median: further off from the start, it lies on another part of the face


def across(labels: IntArray, seen: IntArray, points: FloatArray, triangles: IntArray, matches: Matches) -> BoolArray:
    """(m,) matches of a lip or lid that lie on the other one, as far as the face as it is now tells.

    :param labels: (n,) or none: points of +a and -a never correspond
    :param seen: (m,) points that `matches` are of
    """
    found = np.zeros(len(seen), bool)
    if not len(labels):
        return found
    own, corners = labels[seen], labels[triangles]
    rows = np.flatnonzero((own != 0) & matches.kept)
    marked = np.flatnonzero((corners != 0).all(axis=1) & (corners == corners[:, :1]).all(axis=1))
    if len(rows) and len(marked):
        places = closest_places(matches.places[rows], points, triangles[marked])
        found[rows] = corners[marked[places.triangles], 0] == -own[rows]
    return found


def huber_weights(distances: FloatArray, limits: FloatArray | float) -> FloatArray:
    """Weights of Huber's loss: linear beyond the limits."""
    return np.asarray(limits / np.maximum(distances, limits))


def farthest_anchor(off: FloatArray) -> float:
    """Distance beyond which an anchor is told as an outlier."""
    return max(_ANCHOR_OUTLIER, 4.0 * float(np.median(off))) if len(off) else 0.0


def rough_trust(off: FloatArray, limit: float) -> FloatArray:
    """Huber's weights for the first steps, where even right anchors lie off. A blunder says nothing: a few of them
    would shrink the scan and bend the model to meet it."""
    farthest = max(_ANCHOR_BLUNDER, 5.0 * float(np.median(off))) if len(off) else 0.0
    return np.asarray(huber_weights(off, limit) * (off <= farthest))


def anchor_trust(off: FloatArray) -> FloatArray:
    """Tukey's weights: an outlier says nothing, others nearly all that they have to say."""
    return np.asarray(np.maximum(1.0 - (off / max(farthest_anchor(off), 1e-12)) ** 2, 0.0) ** 2)


def means_around(base: FloatArray, triangles: IntArray) -> Any:
    """(n, n) sparse: means over the points around each. An anchor that pulled one point alone would draw a spike."""
    from scipy.sparse import csr_array, diags_array, identity

    count = len(base)
    pairs, _ = cotangent_weights(base, triangles)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    near = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)) + identity(count)
    mean = diags_array(1.0 / near.sum(axis=1)) @ near
    return (mean @ mean).tocsr()
