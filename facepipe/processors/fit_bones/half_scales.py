"""Bone coefficients whose scales SkelAnimation, which keeps them in half precision, holds as they are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.rig import Rig
from facepipe.rig.trs import decompose

FloatArray = npt.NDArray[np.floating]


def with_half_scales(rig: Rig, coefficients: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """(m, 9) float32 numbers near (m, 9) `coefficients`: local transforms whose scales are half precision.

    Where limits (m, 9) leave no such scale beside a coefficient, and where a transform has shear, it stays as it is.
    """
    local = decompose(rig.local_transforms(coefficients))
    nearest = _half(local.scale)
    found = np.array(coefficients, dtype=np.float64)
    done = np.broadcast_to(local.sheared[:, None], nearest.shape) | (local.scale == 0) | ~np.isfinite(nearest)
    for half in (nearest, _beside(nearest, np.inf), _beside(nearest, -np.inf)):
        with np.errstate(divide="ignore", invalid="ignore"):
            scales = (found[:, 6:] * half / local.scale).astype(np.float32).astype(np.float64)
        fits = ~done & (lower[:, 6:] <= scales) & (scales <= upper[:, 6:])
        found[:, 6:] = np.where(fits, scales, found[:, 6:])
        done = done | fits
    return found


def _half(values: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(values.astype(np.float16).astype(np.float64))


def _beside(halves: FloatArray, direction: float) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(np.nextafter(halves.astype(np.float16), np.float16(direction)).astype(np.float64))
