"""Random values that vary slowly over a face."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]


def smooth_field(points: FloatArray, length: float, channels: int, rng: np.random.Generator) -> FloatArray:
    """(n, channels) values of RMS about 1 that vary over `length` millimetres."""
    waves = rng.standard_normal((24, 3))
    waves *= 2.0 * np.pi / length / np.linalg.norm(waves, axis=1, keepdims=True)
    phases = points @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 24)
    return np.asarray(np.cos(phases) @ rng.standard_normal((24, channels)) * np.sqrt(2.0 / 24))
