"""Few shapes that frames of points are sums of."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]


def motion_basis(deltas: FloatArray, tolerance: float, most: int) -> tuple[FloatArray, FloatArray]:
    """The fewest orthonormal shapes that leave at most `tolerance` of all frames (RMS over points), up to `most`.

    Principal components about rest, by the frames' Gram matrix: frames are fewer than coordinates.

    :param deltas: (f, n, 3) from rest
    :param tolerance: in the unit of the deltas
    :returns: shapes (r, n, 3), and what frames have of them (f, r)
    """
    frames, points = len(deltas), deltas.shape[1]
    flat = np.asarray(deltas).reshape(frames, -1)
    values, vectors = np.linalg.eigh((flat @ flat.T).astype(np.float64))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.append(np.cumsum(values[::-1])[::-1], 0.0)  # squares that the first r leave
    enough = int(np.argmax(left <= tolerance**2 * frames * points))
    solid = int(np.count_nonzero(values > 1e-10 * values[0])) if frames else 0
    count = max(1, min(enough, most, solid))
    sizes = np.sqrt(np.maximum(values[:count], np.finfo(np.float64).tiny))
    shapes = ((vectors[:, :count] / sizes).T @ flat).reshape(count, points, 3)
    return shapes, vectors[:, :count] * sizes
