"""Points sorted into groups that the same columns (shapes or joints) move, so that zeros need not be stored.

A sparse (points, columns) matrix becomes a few small dense ones: one per group, holding only the columns that act on
it. The unit is a block of consecutive points, since putting results back into point order costs per block. Groups
are merged bottom up while the zeros that a merge fills in cost less than a node of the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from facepipe.core.arrays import FloatArray, IntArray

Mask = npt.NDArray[np.bool_]

# Costs in bytes of stored tensors that could be read meanwhile, at 25 GB/s.
_GROUP_BYTES = 50_000  # two small nodes
_BLOCK_BYTES = 80  # one row of a Gather
_TRIM_BYTES = 250_000  # cutting the points that fill the last block up
_BLOCK_SIZES = range(1, 17)
_MAX_GROUPS = 256
_MAX_PATTERNS = 2048


class Group(NamedTuple):
    """Blocks of points and the columns that act on at least one of them, both ascending."""

    columns: IntArray  # (k,)
    blocks: IntArray  # (m,)


class Partition(NamedTuple):
    """All blocks in groups. A block is `size` consecutive points; the last one repeats the last point as filling."""

    size: int
    points: int
    groups: tuple[Group, ...]

    @property
    def order(self) -> IntArray:
        """(blocks,) block numbers in the order of the groups."""
        return np.concatenate([group.blocks for group in self.groups])

    @property
    def position(self) -> IntArray:
        """(blocks,) where each block stands in the order of the groups."""
        return np.argsort(self.order, kind="stable")

    def members(self, group: Group) -> IntArray:
        """(m * size,) point indices of a group."""
        indices = group.blocks[:, None] * self.size + np.arange(self.size)
        return np.asarray(np.minimum(indices, self.points - 1).ravel())


def block_size(matrices: Sequence[tuple[sparse.csr_array, int]], points: int) -> int:
    """The number of consecutive points that are best kept together.

    :param matrices: (points, columns) sparse matrices, each with the bytes stored for one of its entries
    """
    costs = []
    for size in _BLOCK_SIZES:
        filled = sum(cost * size * int(_block_mask(matrix, size).sum()) for matrix, cost in matrices)
        blocks = -(-points // size)
        costs.append(1.2 * filled + _BLOCK_BYTES * blocks + (_TRIM_BYTES if points % size else 0))
    return _BLOCK_SIZES[int(np.argmin(costs))]


def partition(matrix: sparse.csr_array, size: int, entry_bytes: int) -> Partition:
    """Groups of the rows of a (points, columns) sparse matrix, in blocks of `size`.

    :param entry_bytes: bytes stored for one entry of the matrix
    """
    mask = _block_mask(matrix, size)
    patterns, pattern_of, counts = _patterns(mask)
    labels = _merge(patterns, counts * size * entry_bytes)[pattern_of]
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    groups.sort(key=lambda blocks: int(blocks[0]))
    return Partition(
        size, matrix.shape[0], tuple(Group(np.flatnonzero(mask[blocks].any(axis=0)), blocks) for blocks in groups)
    )


def _block_mask(matrix: sparse.csr_array, size: int) -> Mask:
    """(blocks, columns) whether any point of a block has an entry."""
    coo = matrix.tocoo()
    rows, columns = coo.coords
    mask = np.zeros((-(-matrix.shape[0] // size), matrix.shape[1]), dtype=bool)
    mask[rows[coo.data != 0] // size, columns[coo.data != 0]] = True
    return mask


def _patterns(mask: Mask) -> tuple[Mask, IntArray, IntArray]:
    """Distinct rows (p, columns), the row that each row of `mask` belongs to, and how often each occurs.

    More than `_MAX_PATTERNS` are thinned by uniting neighbours in sorted order.
    """
    packed = np.packbits(mask, axis=1)
    if not packed.shape[1]:
        return mask[:1], np.zeros(len(mask), np.int64), np.array([len(mask)])
    rows = np.ascontiguousarray(packed).view(f"V{packed.shape[1]}").ravel()
    _, first, pattern_of = np.unique(rows, return_index=True, return_inverse=True)
    patterns = mask[first]
    if len(patterns) > _MAX_PATTERNS:
        bucket = np.arange(len(patterns)) * _MAX_PATTERNS // len(patterns)
        patterns = np.maximum.reduceat(patterns, np.searchsorted(bucket, np.arange(_MAX_PATTERNS)), axis=0)
        pattern_of = bucket[pattern_of]
    return patterns, pattern_of, np.bincount(pattern_of, minlength=len(patterns))


def _merge(patterns: Mask, weight: FloatArray | IntArray) -> IntArray:
    """(p,) labels of patterns merged greedily, the pair with the least fill first.

    The bytes of a group are ``|union of its patterns| * weight``.
    """
    union, weight = patterns.astype(np.float64), weight.astype(np.float64)
    labels, alive = np.arange(len(union)), np.ones(len(union), dtype=bool)
    width = union.sum(axis=1)
    fill = np.empty((len(union), len(union)))
    for i in range(len(union)):
        fill[i] = _fill(union, width, weight, alive, i)
    nearest, least = fill.argmin(axis=1), fill.min(axis=1)
    for groups in range(len(union), 1, -1):
        keep = int(least.argmin())
        gone = int(nearest[keep])
        if least[keep] >= _GROUP_BYTES and groups <= _MAX_GROUPS:
            break
        labels[labels == gone] = keep
        union[keep] = np.maximum(union[keep], union[gone])
        width[keep], weight[keep] = union[keep].sum(), weight[keep] + weight[gone]
        alive[gone] = False
        fill[gone], fill[:, gone], least[gone] = np.inf, np.inf, np.inf
        row = _fill(union, width, weight, alive, keep)
        fill[keep], fill[:, keep] = row, row
        # only rows that the merge concerns: all pairs anew each time would be cubic in the patterns
        stale = np.flatnonzero(alive & (np.isin(nearest, (keep, gone)) | (row < least)))
        nearest[stale], least[stale] = fill[stale].argmin(axis=1), fill[stale].min(axis=1)
    return labels


def _fill(union: FloatArray, width: FloatArray, weight: FloatArray, alive: Mask, group: int) -> FloatArray:
    """(p,) zeros in bytes that merging `group` with each other group brings; infinite where there is none."""
    united = width + width[group] - union @ union[group]
    fill = united * (weight + weight[group]) - width * weight - width[group] * weight[group]
    fill[~alive] = np.inf
    fill[group] = np.inf
    return np.asarray(fill)
