"""Where hair grows on the average head, by place in cm: y up, z to the front."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray

_ACROSS = (0.0, 1.5, 3.0, 4.6, 6.0, 7.5)  # cm from the middle
_FOREMOST = (7.0, 6.6, 4.6, 2.4, 1.6, 2.6)  # there hair begins that has receded
_TEMPLES = 8.0  # height up to which the sides keep theirs


def receded(at: FloatArray) -> FloatArray:
    """(...,) cm inside the hairline of a man whose temples and crown have receded, at places (..., 3)."""
    front = np.interp(np.abs(at[..., 0]), _ACROSS, _FOREMOST) - at[..., 2]
    return np.asarray(np.maximum(front, _TEMPLES - at[..., 1]))


def bearded(style: str, at: FloatArray) -> FloatArray:
    """(...,) 0..1 how far places (..., 3) of the beard's zone are in that of a style."""
    across, height = np.abs(at[..., 0]), at[..., 1]
    if style == "full":
        return np.ones(across.shape)
    around = np.clip((3.4 - across) / 0.6, 0.0, 1.0) * (at[..., 2] > 4.0)
    if style == "goatee":
        return np.asarray(around)
    return np.asarray(around * np.clip((height + 4.3) / 0.4, 0.0, 1.0))
