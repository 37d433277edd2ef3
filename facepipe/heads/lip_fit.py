"""Lips of a person that meet at rest: identity modes part those of some people, so that teeth show, and press others.

Points of lips lie on loops around the mouth, counted from the border of its inside. Seen from the front, the lowest of
the upper lip has to reach the highest of the lower one all along the mouth: each goes half the way, and the skin around
them less and less.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.heads.asset import asset

_INSIDE = slice(11248, 13294)  # points of the mouth's inside
# loops that may meet those of the other lip; skin stays at the first loop, and from the last on
_MEETING = slice(3, 11)
_LOOPS = 22
_OVER, _OVERLAP = 0.015, 0.014  # cm that lips reach over one another at least, and go into one another at most
_UPPER = 0.75  # of what takes lips out of one another; teeth come over a lower lip that goes half of it, and rolls in
_DEPTHS = 25  # places from front to back
_ALONG = 301  # places along the mouth: a cell of a tooth shows between them at 151 in one of 100 people, two at 75
_CORNER = 0.015  # of its width from each end, where lips part from one another
_ROUNDS = 6  # once they have moved, lips meet at other places


def fit_lips(points: FloatArray) -> FloatArray:
    """The points (n, 3) of a head, in centimetres, with lips that meet."""
    fitted, halves = points.copy(), _lips()
    right, left = points[halves[0][_MEETING.start][[0, -1]], 0]
    x = np.linspace(right, left, _ALONG)
    taper = np.clip(np.minimum(x - right, left - x) / (_CORNER * (left - right)), 0.0, 1.0)
    shares = np.interp(np.arange(_LOOPS), [0, _MEETING.start, _MEETING.stop - 1, _LOOPS - 1], [0, 1, 1, 0])
    shares = shares**2 * (3.0 - 2.0 * shares)
    for _ in range(_ROUNDS):
        upper, lower = (_outlines(fitted, half[_MEETING], x) for half in halves)
        gap = upper[0].min(axis=0) - lower[0].max(axis=0)
        closing = taper * np.maximum(gap + _OVER, 0.0)
        opening = taper * np.maximum(_overlap(upper, lower) - _OVERLAP, 0.0)
        ways = _UPPER * opening - 0.5 * closing, 0.5 * closing - (1.0 - _UPPER) * opening
        for half, way in zip(halves, ways, strict=True):
            for loop, share in zip(half, shares, strict=True):
                inner = loop[1:-1]  # corners stay
                fitted[inner, 1] += share * np.interp(fitted[inner, 0], x, way)
    return fitted


def _outlines(points: FloatArray, loops: list[IntArray], x: FloatArray) -> FloatArray:
    """(2, loops, k) heights and depths of the loops of a lip at k places along the mouth."""
    return np.array([[np.interp(x, points[loop, 0], points[loop, axis]) for loop in loops] for axis in (1, 2)])


def _overlap(upper: FloatArray, lower: FloatArray) -> FloatArray:
    """(k,) how far lips go into one another at each of k places, by the outlines (2, loops, k) of both.

    Loops do not follow one another from back to front where a lip rolls, as lips do towards their corners: 0.7 mm of
    somebody's was not seen when they were taken to.
    """
    depths = np.stack([upper[1], lower[1]])
    low, high = depths.min(axis=1).max(axis=0), depths.max(axis=1).min(axis=0)
    at = np.linspace(low, high, _DEPTHS)[:, None]
    into = np.fmax.reduce(_heights(lower, at), axis=1) - np.fmin.reduce(_heights(upper, at), axis=1)
    return np.where(high > low, np.fmax(np.fmax.reduce(into), -np.inf), -np.inf)


def _heights(outline: FloatArray, at: FloatArray) -> FloatArray:
    """(depths, loops - 1, k) heights of what joins loops of an outline (2, loops, k), at depths (depths, 1, k); NaN
    where it does not reach them."""
    height, depth = outline
    run = np.diff(depth, axis=0)
    share = (at - depth[:-1]) / np.where(run == 0.0, np.nan, run)
    reached = (share >= 0.0) & (share <= 1.0)
    return np.where(reached, height[:-1] + share * np.diff(height, axis=0), np.nan)


@cache
def _lips() -> tuple[list[IntArray], list[IntArray]]:
    """Points of the upper and of the lower half of each loop, from the right corner of the mouth to the left."""
    head = asset()
    links, count = head.links, len(head.points)
    seen = np.zeros(count, bool)
    seen[_INSIDE] = True
    loop = np.flatnonzero(seen)
    kinds = np.zeros((count, 2))  # of the upper half, of the lower; corners are of both
    upper, lower = [], []
    for number in range(_LOOPS):
        loop = np.flatnonzero((links[:, loop].sum(axis=1) > 0) & ~seen)
        loop = loop[np.argsort(head.points[loop, 0], kind="stable")]
        if number == 0:  # wide open: farther out, lips lie on one another
            across = np.interp(head.points[loop, 0], *head.points[loop[[0, -1]], :2].T)
            kinds[loop, 0], kinds[loop, 1] = head.points[loop, 1] >= across, head.points[loop, 1] <= across
        else:
            kinds[loop] = (links[loop] * seen) @ kinds > 0
        seen[loop] = True
        upper.append(loop[kinds[loop, 0] > 0])
        lower.append(loop[kinds[loop, 1] > 0])
    return upper, lower
