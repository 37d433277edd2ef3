"""Which looks at a face to keep: sharp, at rest, and from sides as different as there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.photo.frames.look import Look

_ALIKE = 6  # looks from nearly the same side, or a quarter of all, that each one is measured by
# Degrees of another side that outweigh a fault: a face without any detail, shut eyes, a mouth open by a tenth of the
# face's size more than others, landmarks one unit of error less sure than others; and less sure than a side view's.
_BLURRED, _SHUT, _OPEN, _DOUBTED, _UNSURE = 80.0, 40.0, 30.0, 2.0, 4.0
_OPEN_BY, _SIDE_ERROR = 0.1, 6.0
_SHARP, _AWAKE = 0.95, 0.8  # shares of the others' sharpness and of their lids' height that are no fault
_UP = 1.5  # what a degree up or down counts: heads nod less than they turn
_ANOTHER = 4.0  # degrees: a look from nearer by shows nothing new


def choose(looks: Sequence[Look], count: int) -> list[int]:
    """Indices of at most `count` looks, in their order: the best one near the front, then always the one that is
    farthest from those before, less its faults.

    Fewer where no further look is from another side.
    """
    faults, apart = faults_of(looks), angles(looks)
    kept = [int(np.argmin(np.linalg.norm(_sides(looks), axis=1) + faults))]
    while len(kept) < min(count, len(looks)):
        away = apart[:, kept].min(axis=1)
        gain = np.where(away < _ANOTHER, -np.inf, away - faults)
        best = int(np.argmax(gain))
        if gain[best] == -np.inf:
            break
        kept.append(best)
    return sorted(kept)


def faults_of(looks: Sequence[Look]) -> FloatArray:
    """(n,) degrees of another side that would outweigh each look's faults."""
    lids, lips, errors = (np.array([getattr(look, name) for look in looks]) for name in ("lids", "lips", "error"))
    blurred = np.maximum(1 - relative_sharpness(looks) / _SHARP, 0)
    shut = np.maximum(1 - lids / (_AWAKE * usual(looks, lids, 0.6)), 0)
    opened = np.maximum(lips - usual(looks, lips, 0.25), 0) / _OPEN_BY
    doubted = np.maximum(errors - usual(looks, errors, 0.25), 0)
    unsure = np.maximum(errors - _SIDE_ERROR, 0)
    return np.asarray(
        _BLURRED * blurred + _SHUT * shut + _OPEN * opened + _DOUBTED * doubted + _UNSURE * unsure, dtype=np.float64
    )


def relative_sharpness(looks: Sequence[Look]) -> FloatArray:
    """(n,) sharpness over that of sharp looks from nearly the same side: a cheek has less detail than eyes."""
    sharp = np.array([look.sharpness for look in looks])
    return np.asarray(np.minimum(sharp / usual(looks, sharp, 0.75), 1.0))


def usual(looks: Sequence[Look], values: FloatArray, share: float) -> FloatArray:
    """(n,) the value that a share of the looks from nearly the same side is below."""
    near = np.argsort(angles(looks), axis=1, kind="stable")[:, : max(_ALIKE, len(looks) // 4)]
    return np.maximum(np.quantile(values[near], share, axis=1), 1e-9)


def angles(looks: Sequence[Look]) -> FloatArray:
    """(n, n) degrees between the sides that looks are from."""
    sides = _sides(looks)
    return np.asarray(np.linalg.norm(sides[:, None] - sides, axis=2))


def _sides(looks: Sequence[Look]) -> FloatArray:
    """(n, 2) degrees."""
    return np.degrees([(look.yaw, _UP * look.pitch) for look in looks])
