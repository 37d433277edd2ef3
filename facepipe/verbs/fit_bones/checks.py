"""Whether a rig, its limits, settings, point weights and targets can be fitted, and warnings of what may be wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe.rig import CHANNELS, Rig
from facepipe.rig.trs import decompose
from facepipe.verbs.same_topology import check_invertible, check_spaces

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.targets import Target

LEAST_SCALE = 0.01  # where a lower limit of a scale is infinite
_EVEN = 1e-4  # scales that differ less, relative to the largest, are the same
_SHOWN = 4  # names of a list
_FARTHEST = 1000.0  # sizes of the face: no pose, and beyond what its numbers stand for
_OTHER_SIZE = 4.0  # times as large, or as small: perhaps other units


def check_rig(where: str, parts: FaceParts, rig: Rig) -> None:
    """Check that bones move points.

    :raises InputError: no joints, or no point that follows one
    :raises TopologyError: singular bind transforms or spaces
    """
    if not rig.joints:
        raise InputError(where, "has no joints, expected a skinned face (`facepipe skin` makes one)")
    if rig.influences[:, : len(rig.joints)].nnz == 0:
        raise InputError(where, "no point follows a joint, expected a skinned face (`facepipe skin` makes one)")
    rig.require_linear("the fit")
    check_spaces(where, parts)
    for joint, bind, rest in zip(rig.joints, parts.skeleton.bind_transforms, rig.rest, strict=True):
        check_invertible(f"{where} -> {joint}", "bind transform", bind)
        check_invertible(f"{where} -> {joint}", "rest transform", rest)


def rest_shear(rig: Rig) -> list[str]:
    """A warning of joints whose rest scale is not the same in all directions: what turns at or below them shears."""
    scales = np.abs(decompose(rig.rest).scale)
    uneven = np.flatnonzero(scales.max(axis=1) - scales.min(axis=1) > _EVEN * scales.max(axis=1))
    if not len(uneven):
        return []
    names = _some([rig.joints[number] for number in uneven])
    return [f"rest scale of {names} differs by direction: rotations at and below shear, which not every engine keeps"]


def local_shear(rig: Rig, coefficients: FloatArray) -> str:
    """A few names of joints whose local transforms have shear in a frame of (T, m, 9) coefficients; "" for none."""
    sheared = np.stack([decompose(rig.local_transforms(frame)).sheared for frame in coefficients]).any(axis=0)
    return _some([rig.joints[number] for number in np.flatnonzero(sheared)])


def _some(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


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
    shape, both = (len(rig.joints), 9), []
    for given, default in ((lower, -np.inf), (upper, np.inf)):
        limits = np.full(shape, default) if given is None else np.array(given, dtype=np.float64)
        if limits.shape != shape or np.isnan(limits).any():
            raise InputError(rig.name, f"limits {limits.shape}, expected {shape} numbers")
        both.append(limits)
    low, high = both
    # a scale of 0 makes the joint's matrix singular, one below mirrors: a descent without limit may go there
    low[:, 6:] = np.where(np.isneginf(low[:, 6:]), LEAST_SCALE, low[:, 6:])
    wrong = np.argwhere((low > high) | np.isposinf(low) | np.isneginf(high))
    if len(wrong):
        joint, channel = wrong[0]
        least, most = low[joint, channel], high[joint, channel]
        crossed = f"lower limit {least:g} above the upper {most:g}"
        what = crossed if least > most else f"limits {least:g} to {most:g}, expected finite ones"
        raise InputError(f"{rig.name} -> {rig.joints[joint]} -> {CHANNELS[channel]}", what)
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


def check_targets(targets: Sequence[Target], rest: FloatArray, weights: FloatArray) -> None:
    """Check targets against the (n, 3) points of the face at rest, of which those with a weight (n,) count.

    :raises InputError: no target, another number of points, no point that counts, or points far from any pose
    """
    if not targets:
        raise InputError("targets", "none given, expected at least one")
    for target in targets:
        if target.points.shape[1] != len(rest):
            raise InputError(f"target {target.name}", f"{target.points.shape[1]:,} points, expected {len(rest):,}")
        counts = _counting(target, weights)
        if not counts.any():
            raise InputError(f"target {target.name}", "knows no point that counts")
        size = float(np.ptp(rest[counts], axis=0).max())
        farthest = float(np.abs(target.points[:, counts] - rest[counts].mean(axis=0)).max())
        if size > 0 and farthest > _FARTHEST * size:
            what = f"points {farthest / size:.3g} times the face's size away, expected less than {_FARTHEST:g}"
            raise InputError(f"target {target.name}", f"{what}: are its units right?")


def size_warning(target: Target, name: str, rest: FloatArray, weights: FloatArray) -> list[str]:
    """A line where a target is so much larger or smaller than the face that its units may be others."""
    counts = _counting(target, weights)
    size, sizes = np.ptp(rest[counts], axis=0).max(), np.ptp(target.points[:, counts], axis=1).max(axis=1)
    ratios = sizes / size if size > 0 else np.ones(1)
    ratio = float(ratios.max() if ratios.max() > _OTHER_SIZE else ratios.min())
    if 1 / _OTHER_SIZE <= ratio <= _OTHER_SIZE:
        return []
    return [f"{name}: is {ratio:.3g} times as large as the face: are its units right?"]


def _counting(target: Target, weights: FloatArray) -> BoolArray:
    counts: BoolArray = weights > 0
    return counts if target.known is None else counts & target.known
