"""Bone coefficients of a payload against the limits of the face that they are for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facepipe.core.errors import InputError
from facepipe.parts import BoneLimits
from facepipe.payload import PayloadContent, as_stored
from facepipe.rig import CHANNELS
from facepipe.stage import Face


def check_limits(joints: Sequence[str], limits: BoneLimits) -> None:
    """:raises InputError: a lower limit above its upper one"""
    crossed = np.argwhere(np.asarray(limits.lower) > np.asarray(limits.upper))
    if len(crossed):
        joint, channel = crossed[0]
        what = f"lower limit {limits.lower[joint, channel]:g} above the upper {limits.upper[joint, channel]:g}"
        raise InputError(f"bone limits -> {joints[joint]} -> {CHANNELS[channel]}", what)


def beyond_limits(face: Face, content: PayloadContent) -> tuple[str, ...]:
    """``joint:channel`` of what some frame has beyond the face's limits, as these are in the payload's precision.

    :raises InputError: limits of the face that cross
    """
    limits = _limits(face)
    if limits is None:
        return ()
    stored = as_stored(content.frames, content.precision)
    lower, upper = (as_stored(one, content.precision) for one in (limits.lower, limits.upper))
    beyond = ((stored < lower) | (stored > upper)).any(axis=0)
    return tuple(f"{content.joints[joint]}:{CHANNELS[channel]}" for joint, channel in np.argwhere(beyond))


def within_limits(face: Face, content: PayloadContent) -> PayloadContent:
    """The coefficients brought into the face's limits.

    :raises InputError: limits of the face that cross
    """
    limits = _limits(face)
    if limits is None:
        return content
    return replace(content, coefficients=np.clip(content.coefficients, limits.lower, limits.upper))


def _limits(face: Face) -> BoneLimits | None:
    limits = face.parts().bone_limits
    if limits is not None:
        check_limits(face.skeleton.joints, limits)
    return limits
