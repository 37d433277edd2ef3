"""Sums over groups of rows."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray


def group_sums(group: IntArray, values: FloatArray, count: int) -> FloatArray:
    """(count, c) sums of the rows of `values` (n, c) by their group (n,), 0 where a group has none.

    Column by column: many times faster than `numpy.add.at`.
    """
    return np.stack([np.bincount(group, column, minlength=count) for column in values.T], axis=1)
