"""sRGB and linear light."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray


def from_srgb(values: FloatArray) -> FloatArray:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def to_srgb(values: FloatArray) -> FloatArray:
    """sRGB of linear light, clipped to 0..1 (IEC 61966-2-1)."""
    clipped = np.clip(values, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * np.maximum(clipped, 0.0031308) ** (1 / 2.4) - 0.055)
