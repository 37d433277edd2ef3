"""Slider values to measure at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Slider
from facepipe_onnx.ramps import Ramps

_BUSY = (0.05, 0.2, 0.5, 1.0)  # shares of the sliders that are off their defaults


def slider_samples(sliders: Sequence[Slider], count: int, seed: int) -> FloatArray:
    """(count, sliders) values: the defaults, then random ones of few sliders and of many."""
    random = np.random.default_rng(seed)
    low, high, rest = (np.array([getattr(one, key) for one in sliders]) for key in ("minimum", "maximum", "default"))
    values = low + random.random((count, len(sliders))) * (high - low)
    moved = random.random(values.shape) < random.choice(_BUSY, size=(count, 1))
    moved[0] = False
    return np.where(moved, values, rest)


def ramp_samples(ramps: Ramps, values: FloatArray) -> FloatArray:
    """(count, k) values 0..1 of the ramps under (count, sliders) values."""
    return np.asarray(((values[:, ramps.sliders] - ramps.starts) / (ramps.ends - ramps.starts)).clip(0.0, 1.0))
