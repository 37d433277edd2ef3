"""An order of points in which neighbours in a row are near one another."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def halved(places: FloatArray) -> IntArray:
    """(n,) points in the order of a balanced k-d tree: halved across the longest side of their box, the lower half
    first, and each half again. Any piece of a power of 2, at a multiple of it, is then a cell where n is one too.

    Source: Bentley, Multidimensional binary search trees (1975).

    :param places: (n, 3)
    """
    pieces: list[IntArray] = [np.arange(len(places))]
    while any(len(piece) > 1 for piece in pieces):
        pieces = [half for piece in pieces for half in _halves(places, piece)]
    return np.concatenate(pieces)


def _halves(places: FloatArray, piece: IntArray) -> list[IntArray]:
    if len(piece) < 2:
        return [piece]
    own = places[piece]
    ordered = piece[np.argsort(own[:, np.ptp(own, axis=0).argmax()], kind="stable")]
    middle = (len(piece) + 1) // 2
    return [ordered[:middle], ordered[middle:]]
