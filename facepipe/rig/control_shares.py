"""Controls as shares of their ranges from their defaults: what the network of a neural rig takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.rig.neural_rig import Control


def share_limits(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray]:
    """(c,) lowest shares, 0 or less, and (c,) highest, 0 or more."""
    low, high, rest = _columns(controls)
    return (low - rest) / (high - low), (high - rest) / (high - low)


def values_of(controls: Sequence[Control], x: FloatArray) -> FloatArray:
    """(..., c) values, within limits, of (..., c) shares: the inverse of `from_default`."""
    low, high, rest = _columns(controls)
    return np.asarray(np.clip(rest + x * (high - low), low, high))


def _columns(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray, FloatArray]:
    rows = np.array([(one.minimum, one.maximum, one.default) for one in controls], dtype=np.float64).reshape(-1, 3)
    return rows[:, 0], rows[:, 1], rows[:, 2]
