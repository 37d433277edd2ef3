"""What a bone fit takes: settings in range, limits, weights of points and joints that have a size at rest."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.rig import CHANNELS, Rig

LEAST_SCALE = 0.01  # where a lower limit of a scale is infinite


def check_settings(where: str, settings: Mapping[str, float]) -> None:
    """Check numbers by their names.

    :raises InputError: one that is negative or not finite, or sparsity, which counts in thresholds, without threshold
    """
    for name, value in settings.items():
        if not (np.isfinite(value) and value >= 0):
            raise InputError(where, f"{name} {value:g}, expected 0 or more")
    if settings["sparsity"] > 0 and settings["threshold"] == 0:
        raise InputError(where, "threshold 0 of a sparse fit, expected more: strain counts in thresholds")


def check_rest(rig: Rig, parent_world: FloatArray | None) -> None:
    """Check that joints (under a parent, default the skeleton's place) have a size in every direction.

    :raises InputError: one that has none
    """
    worlds = rig.joint_worlds(rig.rest, parent_world)
    flat = np.flatnonzero(np.linalg.matrix_rank(worlds[:, :3, :3]) < 3)
    if len(flat):
        raise InputError(f"{rig.name} -> {rig.joints[flat[0]]}", "singular rest transform, expected an invertible one")


def checked_limits(rig: Rig, lower: FloatArray | None, upper: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """(m, 9) lower and upper limits; infinite where there are none, but those of scales.

    :raises InputError: arrays that don't fit, a lower limit above its upper one, or limits without a finite number
    """
    shape, found = (len(rig.joints), 9), []
    for given, default in ((lower, -np.inf), (upper, np.inf)):
        limits = np.full(shape, default) if given is None else np.array(given, dtype=np.float64)
        if limits.shape != shape or np.isnan(limits).any():
            raise InputError(rig.name, f"limits {limits.shape}, expected {shape} numbers")
        found.append(limits)
    low, high = found
    low[:, 6:] = np.where(np.isneginf(low[:, 6:]), LEAST_SCALE, low[:, 6:])
    wrong = np.argwhere((low > high) | np.isposinf(low) | np.isneginf(high))
    if len(wrong):
        joint, channel = wrong[0]
        own = low[joint, channel], high[joint, channel]
        what = (
            "lower limit {:g} above the upper {:g}" if own[0] > own[1] else "limits {:g} to {:g}, expected finite ones"
        )
        raise InputError(f"{rig.name} -> {rig.joints[joint]} -> {CHANNELS[channel]}", what.format(*own))
    return low, high


def checked_weights(rig: Rig, weights: FloatArray | None) -> FloatArray:
    """(n,) weights of points, the largest 1; all 1 without any given.

    :raises InputError: another number of them, or one that is negative or not finite
    """
    if weights is None:
        return np.ones(len(rig.points))
    given = np.asarray(weights, dtype=np.float64)
    if given.shape != (len(rig.points),) or not (np.isfinite(given) & (given >= 0)).all():
        raise InputError(rig.name, f"point weights {given.shape}, expected {len(rig.points)} of 0 or more")
    largest = float(given.max(initial=0.0))
    return given / largest if largest > 0 else given
