"""Animations at whole frames of another rate, and what that costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.parts import Animation, Skeleton
from facepipe.rig.animation import local_transforms
from facepipe.rig.trs import Trs, decompose, slerp

TICK = 2.0**-10  # seconds before the next key until which a value is held that then changes at once
ON_FRAME = 1e-3  # frames that a time may be off
_NONE = 1e-6  # an error below this is that of float32


def whole_frames(first: float, last: float, fps: float) -> FloatArray:
    """(t,) seconds of the frames from `first` to `last`, outermost ones included."""
    low, high = np.floor(first * fps + ON_FRAME), np.ceil(last * fps - ON_FRAME)
    return np.asarray(np.arange(low, max(high, low) + 1) / fps)


def resampled(skeleton: Skeleton, animation: Animation, fps: float, mm_per_unit: float) -> tuple[Animation, str]:
    """The animation at whole frames of `fps`, and how far lines between these are from its samples, for people.

    Between samples translations, scales and weights are straight, rotations slerp, as USD has them; beyond the ends the
    animation is held. A pose stays as it is.

    :raises InputError: as `local_transforms`
    """
    if animation.times is None:
        return animation, ""
    old = np.asarray(animation.times, dtype=np.float64)
    new = whole_frames(old[0], old[-1], fps)
    off: list[str] = []
    changed = replace(animation, times=new, coefficients=None)
    if animation.joints:
        trs = decompose(local_transforms(skeleton, animation))
        there = _at(trs, old, new)
        changed = replace(changed, translations=there.translation, rotations=there.rotation, scales=there.scale)
        off += _joints_off(trs, _at(there, new, old), mm_per_unit)
    if animation.shape_weights is not None:
        weights = np.asarray(animation.shape_weights, dtype=np.float64)
        there_weights = _lines(weights, old, new)
        changed = replace(changed, shape_weights=there_weights)
        off += _said("weights", np.abs(_lines(there_weights, new, old) - weights).max(initial=0.0), "")
    return changed, ", ".join(off) or "nothing"


def _joints_off(one: Trs, other: Trs, mm_per_unit: float) -> list[str]:
    chord = [np.linalg.norm(one.rotation - sign * other.rotation, axis=-1) for sign in (1, -1)]
    angle = 4 * np.arcsin(np.minimum(np.minimum(*chord) / 2, 1.0)).max(initial=0.0)
    moved = np.linalg.norm(one.translation - other.translation, axis=-1).max(initial=0.0)
    scaled = np.abs(one.scale - other.scale).max(initial=0.0)
    return [
        *_said("translation", moved * mm_per_unit, " mm"),
        *_said("rotation", angle, " rad"),
        *_said("scale", scaled, ""),
    ]


def _said(what: str, size: float, unit: str) -> list[str]:
    return [f"{what} {size:.2g}{unit}"] if size > _NONE else []


def _at(trs: Trs, old: FloatArray, new: FloatArray) -> Trs:
    """(t, j, ...) transforms of samples at `old`, at the times `new`."""
    left, right, share = _between(old, new)
    return Trs(
        _lines(trs.translation, old, new),
        slerp(trs.rotation[left], trs.rotation[right], share[:, None, None]),
        _lines(trs.scale, old, new),
        trs.sheared[left] | trs.sheared[right],
    )


def _lines(values: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    left, right, share = _between(old, new)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[left] + share * (values[right] - values[left]))


def _between(old: FloatArray, new: FloatArray) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """The samples around each new time, and how far it is from the one to the other."""
    left = np.clip(np.searchsorted(old, new, side="right") - 1, 0, len(old) - 1)
    right = np.minimum(left + 1, len(old) - 1)
    span = np.where(right > left, old[right] - old[left], 1.0)
    return left, right, np.clip((new - old[left]) / span, 0.0, 1.0)
