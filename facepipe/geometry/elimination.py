"""How a sparse symmetric system on points is eliminated: in which order, in which dense blocks, and what goes where.

The multifrontal method (Duff & Reid 1983) on a nested dissection. Points of one part are eliminated together, as one
front: they and the later points that they touch by then, its rim. The front's Schur complement on the rim goes to the
front that comes next among the rim's. All of that follows from the links between points alone, so it is found once for
many matrices.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.dissection import dissect, principal

_MOST = 48  # points of a front that is not cut further: larger ones cost arithmetic, smaller ones calls

Block = tuple[slice, slice]


class Transfer(NamedTuple):
    """Where the blocks of a front's Schur complement go: pairs of a block there and a block of it."""

    child: int
    square: tuple[tuple[Block, Block], ...]  # among the own points
    below: tuple[tuple[Block, Block], ...]  # rim by own
    passed: tuple[tuple[Block, Block], ...]  # among the rim: handed on


@dataclass(frozen=True)
class Front:
    """Points that are eliminated together; slices count unknowns, three a point."""

    own: slice  # in the order of elimination
    rim: tuple[tuple[slice, slice], ...]  # runs of later unknowns: in the order of elimination, and in the front's rim
    rows: int  # unknowns of the rim
    children: tuple[Transfer, ...]
    start: int  # of its values: the own block column by column, then the block of the rim by own


@dataclass(frozen=True)
class Elimination:
    """n points, three unknowns each, in m fronts."""

    order: IntArray  # (n,) points as they are eliminated
    fronts: tuple[Front, ...]
    size: int  # of the values of all fronts
    links: IntArray  # (p,) lower * n + higher, ascending: pairs of points with a value
    slots: IntArray  # (p,) where the first of a pair's 3 x 3 values lies
    strides: IntArray  # (p,) from one column of it to the next
    own_slots: IntArray  # (n,) the same for each point with itself
    own_strides: IntArray  # (n,)

    @classmethod
    def of(cls, places: FloatArray, links: IntArray, most: int = _MOST) -> Elimination:
        """The order for systems with values at each point and between linked ones.

        :param places: (n, 3) about where the points are; they decide nothing but how much fills in
        :param links: (p, 2) pairs of points, in any order
        :param most: points of a front that is not cut further
        """
        count = len(places)
        low, high = np.sort(np.asarray(links, np.int64).reshape(-1, 2), axis=1).T
        keys = np.unique((low * count + high)[low < high])
        pairs = np.stack(np.divmod(keys, max(count, 1)), axis=1)
        part = dissect(places, pairs, most)
        order, starts = _order(places, part)
        place = np.empty(count, np.int64)
        place[order] = np.arange(count)
        pairs = np.sort(place[pairs], axis=1)
        bounds = np.append(starts, count)
        front = np.repeat(np.arange(len(starts)), np.diff(bounds))
        rims = _rims(pairs, front, bounds)
        sizes = 9 * np.diff(bounds) * (np.diff(bounds) + np.array([len(rim) for rim in rims], np.int64))
        begin = np.concatenate([[0], np.cumsum(sizes)])
        slots, strides = _slots(pairs, front, bounds, rims, begin)
        itself = np.repeat(np.arange(count)[:, None], 2, axis=1)
        own_slots, own_strides = _slots(itself, front, bounds, rims, begin)
        return cls(
            order=order,
            fronts=_fronts(front, bounds, rims, begin),
            size=int(begin[-1]),
            links=keys,
            slots=slots,
            strides=strides,
            own_slots=own_slots[place],
            own_strides=own_strides[place],
        )


def _order(places: FloatArray, part: IntArray) -> tuple[IntArray, IntArray]:
    """Points (n,) by part, a part right after what lies below it, and where each part starts.

    Within a part along its longest axis, so that what a part below touches of it lies in few runs.
    """
    numbers, group, counts = np.unique(part, return_inverse=True, return_counts=True)
    depth = np.frexp(numbers.astype(np.float64))[1]
    end = (numbers + 1) << (depth.max(initial=0) - depth)  # of what lies below, on the lowest level
    rank = np.empty(len(numbers), np.int64)
    rank[np.lexsort((-depth, end))] = np.arange(len(numbers))
    order = np.lexsort((principal(places, group, counts)[:, 0], rank[group]))
    return order, np.flatnonzero(np.diff(rank[group][order], prepend=-1))


def _rims(pairs: IntArray, front: IntArray, bounds: IntArray) -> list[IntArray]:
    """Later points that each front touches, ascending."""
    across = pairs[front[pairs[:, 0]] != front[pairs[:, 1]]]
    across = across[np.argsort(front[across[:, 0]], kind="stable")]
    cuts = np.searchsorted(front[across[:, 0]], np.arange(len(bounds)))
    found: list[list[IntArray]] = [[across[a:b, 1]] for a, b in pairwise(cuts.tolist())]
    rims = []
    for touched in found:
        rim = np.unique(np.concatenate(touched))
        rims.append(rim)
        if len(rim):
            above = front[rim[0]]
            found[above].append(rim[np.searchsorted(rim, bounds[above + 1]) :])
    return rims


def _slots(
    pairs: IntArray, front: IntArray, bounds: IntArray, rims: list[IntArray], begin: IntArray
) -> tuple[IntArray, IntArray]:
    """Where the 3 x 3 values of pairs (p, 2), the earlier point first, begin, and how far their columns are apart."""
    number = front[pairs[:, 0]]
    column, own = pairs[:, 0] - bounds[number], bounds[number + 1] - bounds[number]
    inside = pairs[:, 1] < bounds[number + 1]
    lengths = np.array([len(rim) for rim in rims], np.int64)
    before = np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(rims) else lengths
    count = len(front)
    keys = np.concatenate([number * count + rim for number, rim in enumerate(rims)]) if rims else lengths
    at = np.searchsorted(keys, number * count + pairs[:, 1]) - before[number]
    stride = np.where(inside, 3 * own, 3 * lengths[number])
    row = np.where(inside, pairs[:, 1] - bounds[number], at)
    return begin[number] + np.where(inside, 0, 9 * own**2) + 3 * column * stride + 3 * row, stride


def _fronts(front: IntArray, bounds: IntArray, rims: list[IntArray], begin: IntArray) -> tuple[Front, ...]:
    children: list[list[Transfer]] = [[] for _ in rims]
    made = []
    for number, (rim, start, end) in enumerate(zip(rims, bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        runs = _paired(rim, 0, 0)
        made.append(Front(_slice(start, end), runs, 3 * len(rim), tuple(children[number]), int(begin[number])))
        if len(rim):
            above = int(front[rim[0]])
            children[above].append(_transfer(number, rim, int(bounds[above]), int(bounds[above + 1]), rims[above]))
    return tuple(made)


def _transfer(child: int, rim: IntArray, start: int, end: int, above: IntArray) -> Transfer:
    """From the rim of a front to the front of points `start` to `end` with the rim `above`."""
    split = int(np.searchsorted(rim, end))
    own = _paired(rim[:split], start, 0)
    rest = _paired(np.searchsorted(above, rim[split:]), 0, split)
    return Transfer(child, _lower(own), tuple(_pair(row, column) for row in rest for column in own), _lower(rest))


def _paired(numbers: IntArray, first: int, offset: int) -> tuple[Block, ...]:
    """Slices of runs of `numbers` less `first`, and of where they stand in the row, `offset` further."""
    places = (numbers - first).tolist()
    runs = _runs(numbers)
    return tuple((_slice(places[a], places[b - 1] + 1), _slice(a + offset, b + offset)) for a, b in runs)


def _lower(runs: tuple[Block, ...]) -> tuple[tuple[Block, Block], ...]:
    """Blocks on and below the diagonal."""
    return tuple(_pair(runs[row], runs[column]) for row in range(len(runs)) for column in range(row + 1))


def _pair(row: Block, column: Block) -> tuple[Block, Block]:
    return (row[0], column[0]), (row[1], column[1])


def _runs(numbers: IntArray) -> list[tuple[int, int]]:
    """Where runs of consecutive numbers begin and end."""
    if not len(numbers):
        return []
    cuts = (np.flatnonzero(numbers[1:] != numbers[:-1] + 1) + 1).tolist()
    return list(zip([0, *cuts], [*cuts, len(numbers)], strict=True))


def _slice(start: int, end: int) -> slice:
    """The unknowns of points."""
    return slice(3 * start, 3 * end)
