"""Few shapes that frames of points are sums of."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from facepipe.core.arrays import FloatArray

_COLUMNS = 1 << 13


def motion_basis(deltas: FloatArray, tolerance: float, most: int) -> tuple[FloatArray, FloatArray]:
    """The fewest orthonormal shapes that leave at most `tolerance` of all frames (RMS over points), up to `most`.

    Principal components about rest, by the frames' Gram matrix: frames are fewer than coordinates.

    :param deltas: (f, n, 3) from rest
    :param tolerance: in the unit of the deltas
    :returns: shapes (r, n, 3), and what frames have of them (f, r)
    """
    frames, points = len(deltas), deltas.shape[1]
    flat = np.asarray(deltas).reshape(frames, -1)
    values, vectors = np.linalg.eigh(sum((piece @ piece.T for piece in _pieces(flat)), np.zeros((frames, frames))))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.append(np.cumsum(values[::-1])[::-1], 0.0)  # squares that the first r leave
    enough = int(np.argmax(left <= tolerance**2 * frames * points))
    solid = int(np.count_nonzero(values > 1e-10 * values[0])) if frames else 0
    count = max(1, min(enough, most, solid))
    sizes = np.sqrt(np.maximum(values[:count], np.finfo(np.float64).tiny))
    shapes = np.concatenate([(vectors[:, :count] / sizes).T @ piece for piece in _pieces(flat)], axis=1)
    return shapes.reshape(count, points, 3), vectors[:, :count] * sizes


def _pieces(flat: FloatArray) -> Iterator[FloatArray]:
    """(f, some) columns as float64: all at once may be too much memory."""
    for start in range(0, flat.shape[1], _COLUMNS):
        yield flat[:, start : start + _COLUMNS].astype(np.float64)
