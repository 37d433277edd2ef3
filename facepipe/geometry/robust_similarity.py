"""The similarity that most of a set of pairs agree on, however wrong some are."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.geometry.similarity import Similarity, fit_similarity

_TRIALS = 300  # of four pairs: with a third of them wrong one in five is clean
_SAMPLE = 4
_INLIER = 2.5  # times the robust standard deviation


def robust_similarity(source: FloatArray, target: FloatArray, *, scale: bool = True, seed: int = 0) -> Similarity:
    """The similarity that moves `source` (n, 3) onto `target` (n, 3) by the least median of squared distances, refined
    on the pairs that fit it. Up to a third of the pairs may be wrong.

    Rousseeuw, "Least median of squares regression", Journal of the American Statistical Association 1984.

    :raises InputError: as `fit_similarity`
    """
    count = len(source)
    best = fit_similarity(source, target, scale=scale)
    if count <= _SAMPLE:
        return best
    rng = np.random.default_rng(seed)
    off = np.linalg.norm(best.apply(source) - target, axis=1)
    least = float(np.median(off))
    for _ in range(_TRIALS):
        chosen = rng.choice(count, _SAMPLE, replace=False)
        tried = fit_similarity(source[chosen], target[chosen], scale=scale)
        distances = np.linalg.norm(tried.apply(source) - target, axis=1)
        if np.median(distances) < least:
            least, off = float(np.median(distances)), distances
    inside = off <= max(_INLIER * 1.4826 * least, np.sort(off)[_SAMPLE - 1])
    return fit_similarity(source[inside], target[inside], scale=scale)
