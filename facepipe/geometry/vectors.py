"""Rows of vectors: under a matrix, as directions, summed by group, their distances from a segment; finite ones."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite


def transformed(points: FloatArray, matrix: FloatArray) -> FloatArray:
    """(..., 3) points under a (4, 4) matrix for column vectors, float64."""
    return np.asarray(np.asarray(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3])


def transformed_each(points: FloatArray, transforms: FloatArray) -> FloatArray:
    """(n, 3) points (n, 3), each under its own of transforms (n, 3, 4) for column vectors."""
    return np.asarray(np.einsum("nij,nj->ni", transforms[:, :, :3], points) + transforms[:, :, 3])


def dot_columns(first: FloatArray, second: FloatArray) -> FloatArray:
    """(n,) products of vectors (3, n): by columns, a fifth of the time of numpy's sums over three numbers a row."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def cross_columns(first: FloatArray, second: FloatArray) -> FloatArray:
    """(3, n) of vectors (3, n)."""
    (a, b, c), (d, e, f) = first, second
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d])


def unit_vectors(vectors: FloatArray) -> FloatArray:
    """(v, c) of length 1; those of length 0 stay."""
    # axis by axis, to the same digits: numpy's reductions are slow over short axes
    lengths = np.sqrt(sum(axis * axis for axis in np.asarray(vectors).T))[:, None]
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0))


def group_sums(group: IntArray, values: FloatArray, count: int) -> FloatArray:
    """(count, c) sums of the rows of `values` (n, c) by their group (n,), 0 where a group has none.

    Column by column: many times faster than `numpy.add.at`.
    """
    return np.stack([np.bincount(group, column, minlength=count) for column in values.T], axis=1)


def to_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(n,) distances of points (n, 3) from the segment between two places (3,)."""
    along = end - start
    t = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - t[:, None] * along, axis=1))


def finite(name: str, values: FloatArray) -> FloatArray:
    """A float64 copy of `values`.

    :raises InputError: NaN or infinity in what is called `name`
    """
    copy = np.array(values, dtype=np.float64)
    require_finite(copy, name)
    return copy
