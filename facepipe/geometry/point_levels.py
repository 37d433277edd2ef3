"""Offsets of a surface's points in few bytes: coarse levels first, each point predicted from its neighbours in these.

Points of a level are predicted by an affine fit to their nearest points in coarser levels (moving least squares: Levin,
"The approximation power of moving least-squares", Mathematics of Computation 1998), nearest by place and normal: upper
and lower lip don't predict each other. What prediction leaves is rounded to steps, and these are coded by how
likely they are given those of the neighbours. Predictions are from what a reader has: errors don't add up. Means of
neighbours instead of the fit take 15 to 25 % more bytes.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.polygons import point_normals
from facepipe.payload.basis import WHOLE, Level
from facepipe.payload.range_coder import KINDS_OF_SIZES, BitReader, BitWriter

_GRID = 1000  # places in a millimetre that count: distances are whole numbers, so that every reader ranks them alike
_NORMAL = 4  # edges that opposite normals count as apart, by half
_CROWD = 100  # neighbours of a point, on average
_COARSEST = 32  # points that no others predict, at most
_NEIGHBOURS = 6
_RIDGE = 0.02  # of slopes against distances, as shares of the farthest neighbour's: few neighbours say little of them
_MOST_OF_SHARES = 127  # of an int8
_NARROW = 3.0  # exponent of the weight that the farthest neighbour loses
_FINER = 1.15  # times finer steps at each coarser level, on which more points depend
_DEAD = 0.53  # of a step: less is rounded to none, which costs little
_NEAR = 4  # neighbours whose steps tell how many a point has
_HEAD = struct.Struct("<fB")  # step in millimetres, levels sent
_MOST_OFFSET = 1e4  # millimetres

# contexts: by how much is going on around
_AROUND = 4
_MOVES = 1  # after that of whole levels
_AXES = _MOVES + _AROUND
_STEPS = _AXES + 3 * 2 * _AROUND
_CONTEXTS = _STEPS + KINDS_OF_SIZES * _AROUND


@dataclass(frozen=True, kw_only=True)
class PointLevels:
    """The levels of some of n points, which `of` makes of a surface at rest. The others have no offsets."""

    count: int  # n
    first: IntArray  # rows of the coarsest level
    levels: tuple[Level, ...]  # the finer ones after it

    @classmethod
    def of(cls, points: FloatArray, triangles: IntArray, some: IntArray | None = None) -> Self:
        """Those of points (n, 3) in millimetres, which triangles (t, 3) join.

        :param some: of these points alone, ascending, and the triangles between them; None: of all
        """
        if some is not None:
            number = np.full(len(points), -1)
            number[some] = np.arange(len(some))
            own = number[triangles]
            made = cls.of(points[some], own[(own >= 0).all(axis=1)])
            renamed = tuple(Level(some[one.rows], some[one.neighbours], one.shares) for one in made.levels)
            return cls(count=len(points), first=some[made.first], levels=renamed)
        edge = _edge(points, triangles)
        places = _places(points, triangles, edge)
        reach = max(int((_GRID * edge) ** 2), 1)  # squared
        finer: list[IntArray] = []
        rows = np.arange(len(places))
        while len(rows) > _COARSEST:
            kept = _apart(places[rows], reach)
            if not kept.all():
                finer.append(rows[~kept])
                rows = rows[kept]
            reach *= 2  # so that about half of the points stay
        levels, known = [], rows
        for own in finer[::-1]:
            neighbours = known[_nearest(places[known], places[own])]
            levels.append(Level(own, neighbours, _shares(places, own, neighbours)))
            known = np.sort(np.append(known, own))
        return cls(count=len(points), first=rows, levels=tuple(levels))

    def encode(
        self, offsets: FloatArray, step: float, coarse: int | None = None, care: FloatArray | None = None
    ) -> tuple[bytes, FloatArray]:
        """Offsets (n, 3) in millimetres as bytes, and as a reader gets them.

        :param step: millimetres; of an axis a point is off by `_DEAD` of it at most
        :param coarse: levels that are sent, the coarsest first; finer ones are predicted. None: all
        :param care: (n,) above 0 to 1, how much it matters where a point is: less has few bytes; None: 1 for all
        """
        first, levels = self.first, self.levels
        sent = len(levels) if coarse is None else min(coarse, len(levels))
        head = _HEAD.pack(step, sent)
        step = _HEAD.unpack(head)[0]
        wanted = offsets if sent == len(levels) else self._standing_for(offsets, sent, care)
        writer, got, steps = BitWriter(_CONTEXTS), np.zeros_like(offsets), np.zeros(offsets.shape, np.int64)
        for number, rows in enumerate((first, *(level.rows for level in levels[:sent]))):
            size = step * _FINER ** (number - sent)
            predicted = np.zeros((len(rows), 3)) if not number else _predicted(levels[number - 1], got)
            ratio = (wanted[rows] - predicted) / size
            dead = (_DEAD if number else 0.5) / (1.0 if care is None else care[rows, None])
            own = (np.sign(ratio) * np.floor(np.maximum(np.abs(ratio) + 1.0 - dead, 0.0))).astype(np.int64)
            around = _around(None if not number else levels[number - 1], steps, len(rows))
            _write(writer, own, around)
            steps[rows], got[rows] = own, predicted + own * size
        for level in levels[sent:]:
            got[level.rows] = _predicted(level, got)
        return head + writer.bytes(), got

    def _standing_for(self, offsets: FloatArray, sent: int, care: FloatArray | None) -> FloatArray:
        """(n, 3) offsets of the points of the levels that are sent whose predictions come nearest to all (n, 3)."""
        from scipy.sparse.linalg import splu

        known, shares = self._spread(sent)
        every = self.rows
        weighted = shares if care is None else shares.multiply(care[every, None] ** 2).tocsr()
        wanted = np.zeros_like(offsets)
        wanted[known] = splu((shares.T @ weighted).tocsc()).solve(weighted.T @ offsets[every])
        return wanted

    def _spread(self, sent: int) -> tuple[IntArray, Any]:
        """Of the coarsest levels: points (m,), and what all of levels take of their offsets, sparse (n, m)."""
        from scipy.sparse import csr_array, eye_array, vstack

        if sent not in self._spreads:
            first, levels = self.first, self.levels
            known = np.concatenate([first, *(level.rows for level in levels[:sent])])
            order, whole = known, csr_array(eye_array(len(known)))
            for level in levels[sent:]:
                place = np.empty(self.count, np.int64)
                place[order] = np.arange(len(order))
                count, k = level.neighbours.shape
                ends = np.arange(0, count * k + 1, k)
                shares = level.shares.ravel() / WHOLE
                own = csr_array((shares, place[level.neighbours].ravel(), ends), (count, len(order)))
                whole = vstack([whole, own @ whole], format="csr")
                order = np.append(order, level.rows)
            self._spreads[sent] = known, whole[np.argsort(order)]
        return self._spreads[sent]

    @cached_property
    def _spreads(self) -> dict[int, tuple[IntArray, Any]]:
        return {}

    def decode(self, data: bytes, where: object) -> FloatArray:
        """The (n, 3) offsets in millimetres of bytes.

        :raises InputError: bytes that are cut, that don't fit these points, or numbers beyond limits
        """
        if len(data) < _HEAD.size:
            raise InputError(where, f"{len(data)} bytes, expected at least {_HEAD.size}")
        step, sent = _HEAD.unpack_from(data)
        first, levels = self.first, self.levels
        if not 0 < step <= _MOST_OFFSET:
            raise InputError(where, f"steps of {step:g} mm, expected more than 0 and at most {_MOST_OFFSET:g}")
        if sent > len(levels):
            raise InputError(where, f"{sent} levels, expected at most the {len(levels)} of these points")
        reader = BitReader(data[_HEAD.size :], _CONTEXTS, where)
        got, steps = np.zeros((self.count, 3)), np.zeros((self.count, 3), np.int64)
        for number, rows in enumerate((first, *(level.rows for level in levels[:sent]))):
            predicted = np.zeros((len(rows), 3)) if not number else _predicted(levels[number - 1], got)
            own = _read(reader, _around(None if not number else levels[number - 1], steps, len(rows)))
            steps[rows], got[rows] = own, predicted + own * (step * _FINER ** (number - sent))
        for level in levels[sent:]:
            got[level.rows] = _predicted(level, got)
        if not np.abs(got).max(initial=0.0) <= _MOST_OFFSET:
            raise InputError(where, f"offsets above {_MOST_OFFSET:g} mm, expected smaller ones")
        return got

    @cached_property
    def rows(self) -> IntArray:
        """Points of all levels, ascending."""
        return np.sort(np.concatenate([self.first, *(level.rows for level in self.levels)]))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Points of each level, the coarsest first."""
        return (len(self.first), *(len(level.rows) for level in self.levels))


def _edge(points: FloatArray, triangles: IntArray) -> float:
    """Millimetres of an edge, in the middle of them; 1 where there are none."""
    edges = points[triangles] - points[np.roll(triangles, 1, axis=1)]
    return float(np.median(np.linalg.norm(edges, axis=2))) if len(triangles) else 1.0


def _places(points: FloatArray, triangles: IntArray, edge: float) -> IntArray:
    """(n, 6) place and normal on the grid."""
    both = np.hstack([points, _NORMAL * edge * point_normals(points, triangles)])
    return np.asarray(np.rint(_GRID * both), np.int64)


def _apart(places: IntArray, reach: int) -> BoolArray:
    """(n,) which of the places, taken in their order, are farther than a squared distance from all taken before."""
    tree, radius = cKDTree(places), math.sqrt(reach) * (1 + 1e-9)
    if tree.count_neighbors(tree, radius) > _CROWD * len(places):
        # heaps of points, whose pairs would fill the memory: one for each cell, which takes a tenth more bytes
        cells = (places - places.min(axis=0)) // max(math.isqrt(reach), 1)
        taken = np.zeros(len(places), bool)
        taken[np.unique(cells, axis=0, return_index=True)[1]] = True
        return taken
    pairs = tree.query_pairs(radius, output_type="ndarray")
    near = ((places[pairs[:, 0]] - places[pairs[:, 1]]) ** 2).sum(axis=1) <= reach
    pairs = np.sort(pairs[near], axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    later, starts = pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(len(places) + 1))
    taken = np.ones(len(places), bool)
    for row in np.unique(pairs[:, 0]).tolist():
        if taken[row]:
            taken[later[starts[row] : starts[row + 1]]] = False
    return taken


def _nearest(known: IntArray, places: IntArray) -> IntArray:
    """(m, k) the nearest of known places to places (m, 6), by distance, then by their order."""
    count, asked = min(_NEIGHBOURS, len(known)), 2 * _NEIGHBOURS
    tree = cKDTree(known)
    while True:
        asked = min(asked, len(known))
        _, near = tree.query(places, asked)
        near = near.reshape(len(places), asked)
        squares = ((known[near] - places[:, None]) ** 2).sum(axis=2)
        order = np.lexsort((near, squares), axis=1)
        near, squares = (np.take_along_axis(values, order, axis=1) for values in (near, squares))
        # whole numbers tie, on a head whose halves mirror each other above all: none of a tie may be left out
        if asked == len(known) or (squares[:, count - 1] < squares[:, -1]).all():
            return np.asarray(near[:, :count])
        asked *= 2


def _shares(places: IntArray, rows: IntArray, neighbours: IntArray) -> npt.NDArray[np.int8]:
    """(m, k) how much of each neighbour an affine fit to them has at the points themselves, in WHOLE-ths."""
    away = (places[neighbours] - places[rows][:, None]).astype(np.float64)
    squares = (away**2).sum(axis=2)
    farthest = np.maximum(squares[:, -1:], 1.0)
    weights = np.exp(-_NARROW * squares / farthest)
    terms = np.concatenate([np.ones((*squares.shape, 1)), away / np.sqrt(farthest)[:, :, None]], axis=2)
    weighted = terms * weights[:, :, None]
    normal = np.swapaxes(terms, 1, 2) @ weighted + np.diag([0.0] + 6 * [_RIDGE])
    constant = np.broadcast_to(np.eye(7)[:, :1], (len(normal), 7, 1))  # the fit at the point itself
    first = np.linalg.solve(normal, constant)
    whole = np.rint(WHOLE * (weighted @ first)[:, :, 0]).astype(np.int64)
    whole[:, 0] += WHOLE - whole.sum(axis=1)
    wild = np.abs(whole).max(axis=1) > _MOST_OF_SHARES
    whole[wild] = np.eye(1, whole.shape[1], dtype=np.int64) * WHOLE  # the nearest one's
    return np.asarray(whole, np.int8)


def _predicted(level: Level, got: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mk,mkc->mc", level.shares / WHOLE, got[level.neighbours]))


def _around(level: Level | None, steps: IntArray, count: int) -> list[int]:
    """(m,) how much is going on around points: 3 where neighbours are many steps from what predicted them."""
    if level is None:
        return [_AROUND - 1] * count
    total = np.abs(steps[level.neighbours[:, :_NEAR]]).sum(axis=(1, 2))
    found: list[int] = np.searchsorted([1, 2, 4], total, side="right").tolist()
    return found


def _write(writer: BitWriter, steps: IntArray, around: list[int]) -> None:
    """Write the steps (m, 3) of a level."""
    moving = bool(steps.any())
    writer.bit(0, moving)
    if not moving:
        return
    still, rows = 0, np.flatnonzero(steps.any(axis=1)).tolist()
    moves = [_MOVES + near for near in around]
    for row, own in zip(rows, steps[rows].tolist(), strict=True):
        writer.zeros(moves[still:row])
        writer.bit(moves[row], 1)
        near, still, before = around[row], row + 1, 0
        for axis, value in enumerate(own):
            size = abs(value)
            if axis < 2 or before:  # the last one moves if none before it did
                writer.bit(_AXES + (2 * axis + before) * _AROUND + near, size > 0)
            if not size:
                continue
            before = 1
            writer.number(value < 0, 1)
            writer.size(size, _STEPS + near, _AROUND)
    writer.zeros(moves[still:])


def _read(reader: BitReader, around: list[int]) -> IntArray:
    """The steps (m, 3) of a level."""
    steps = np.zeros((len(around), 3), np.int64)
    if not reader.bit(0):
        return steps
    for row, near in enumerate(around):
        if not reader.bit(_MOVES + near):
            continue
        before = 0
        for axis in range(3):
            if (axis < 2 or before) and not reader.bit(_AXES + (2 * axis + before) * _AROUND + near):
                continue
            before, negative = 1, reader.number(1)
            size = reader.size(_STEPS + near, _AROUND)
            steps[row, axis] = -size if negative else size
    return steps
