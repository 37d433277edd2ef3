"""Few points of a surface that show what moves it."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray

_PRIOR_VARIANCE = 1.0 / 3.0  # variance of a mover before any point is seen: any value from -1 to 1


def farthest_points(places: FloatArray, weight: FloatArray, count: int) -> IntArray:
    """(count,) points, each the one whose distance to the ones before, times its weight, is the largest.

    Points of weight 0 are never taken: there may be fewer. Source: Gonzalez, Clustering to minimize the maximum
    intercluster distance (1985).

    :param places: (n, 3)
    :param weight: (n,)
    """
    count = min(count, int(np.count_nonzero(weight)))
    chosen = np.zeros(count, np.int64)
    near = np.full(len(places), np.inf)
    for number in range(count):
        chosen[number] = np.argmax(near * weight) if number else np.argmax(weight)
        near = np.minimum(near, np.linalg.norm(places - places[chosen[number]], axis=1))
        near[chosen[number]] = -1.0  # places of several points are taken last, and none twice
    return chosen


def informative_points(moves: FloatArray, noise: float, count: int) -> IntArray:
    """(count,) points, each the one that leaves the least doubt about all movers after the ones before it.

    Doubt is the summed variance of the movers' posterior, where each mover moves the points straight and points are
    seen with noise. With C the covariance of a point with the movers and S its own, noise included, seeing it takes
    ``trace(C C^T S^-1)`` off the doubt; all other covariances then lose what it explains of them, as in a Kalman
    filter, so that no inverse larger than 3 x 3 is needed. Source: greedy A-optimal design, e.g. Pukelsheim, Optimal
    Design of Experiments (1993).

    :param moves: (n, 3, c) how far each of c movers moves a point
    :param noise: standard deviation of a coordinate, in the unit of the moves
    """
    count = min(count, len(moves))
    chosen = np.zeros(count, np.int64)
    seen = moves * _PRIOR_VARIANCE  # (n, 3, c) covariance of points with movers
    spread = np.matmul(moves, seen.transpose(0, 2, 1)) + noise**2 * np.eye(3)  # (n, 3, 3) of points
    for number in range(count):
        inverse = np.linalg.inv(spread)
        gain = np.einsum("nij,nji->n", np.matmul(seen, seen.transpose(0, 2, 1)), inverse)
        gain[chosen[:number]] = -1.0
        taken = chosen[number] = np.argmax(gain)
        covariance = seen[taken].copy()
        shared = moves @ covariance.T  # (n, 3, 3) covariance with the point taken
        gains = shared @ inverse[taken]
        seen -= gains @ covariance
        spread -= gains @ shared.transpose(0, 2, 1)
    return chosen


def well_placed(places: FloatArray, moves: FloatArray, noise: float, count: int, candidates: int) -> IntArray:
    """(<= count,) points that show the movers, out of candidates that are spread over what moves, in the order of
    `halved`. It depends on where points are and how they move, not on how they are numbered.

    :param places: (n, 3)
    :param moves: (n, 3, c)
    """
    chosen = farthest_points(places, np.sqrt(np.linalg.norm(moves, axis=(1, 2))), candidates)
    chosen = chosen[informative_points(moves[chosen], noise, count)]
    return np.asarray(chosen[halved(places[chosen])])


def halved(places: FloatArray) -> IntArray:
    """(n,) points in the order of a balanced k-d tree: halved across the longest side of their box, the lower half
    first, and each half again. Any piece of a power of 2, at a multiple of it, is then a cell where n is one too.

    Source: Bentley, Multidimensional binary search trees (1975).

    :param places: (n, 3)
    """
    pieces: list[IntArray] = [np.arange(len(places))]
    while any(len(piece) > 1 for piece in pieces):
        whole, pieces = pieces, []
        for piece in whole:
            here = places[piece]
            ordered = piece[np.argsort(here[:, np.ptp(here, axis=0).argmax()], kind="stable")]
            middle = (len(piece) + 1) // 2
            pieces += [ordered[:middle], ordered[middle:]] if len(piece) > 1 else [piece]
    return np.concatenate(pieces)
