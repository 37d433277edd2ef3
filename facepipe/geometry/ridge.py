"""Straight maps from noisy numbers."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray


def ridge(seen: FloatArray, told: FloatArray, noise: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """(s, t) and (t,): the map and offset of least squared error from rows of `seen`, each with other noise, to
    `told`.

    Source: Hoerl and Kennard, Ridge regression (1970); its penalty is what the noise brings.

    :param seen: (n, s)
    :param told: (n, t)
    :param noise: standard deviation of the numbers seen, above 0: of all, or of each (s,)
    """
    middle, mean = seen.mean(axis=0), told.mean(axis=0)
    from_middle = np.asarray(seen - middle, np.float64)
    normal = from_middle.T @ from_middle
    normal[np.diag_indices_from(normal)] += len(seen) * noise**2
    found = np.linalg.solve(normal, from_middle.T @ told)  # of whose mean nothing is left
    return found, mean - middle @ found
