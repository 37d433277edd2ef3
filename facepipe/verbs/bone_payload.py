"""Payloads of bone coefficients beside a face: written and read, held against its joints and limits, its points."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.reading import read_bytes
from facepipe.core.reports import Report
from facepipe.parts import BoneLimits
from facepipe.payload import PayloadContent, as_stored, decode, encode
from facepipe.rig import CHANNELS, Rig
from facepipe.stage import Face

SUFFIX = ".fpb"
_MOST_BYTES = 1 << 30
_SHOWN = 4  # names of a list


@dataclass(frozen=True, kw_only=True)
class PayloadReport(Report):
    """What a payload holds, and the largest errors of its rounding."""

    path: Path
    bytes: int
    precision: str
    joints: int
    stored: int  # joints in the file
    frames: int
    error_mm: float  # of a point of the face, over all frames
    translation_error: float  # stage units
    rotation_error: float  # radians
    scale_error: float  # factor


def write_payload(path: str | os.PathLike[str], content: PayloadContent, rig: Rig) -> PayloadReport:
    """Write bone coefficients of a rig, atomically.

    :param rig: its points show what rounding does
    :raises InputError: another suffix, content that is not the rig's or can't be stored, or a folder that can't be
        written
    """
    target = Path(path)
    check_payload_suffix(target)
    if tuple(content.joints) != tuple(rig.joints):
        raise InputError(target, f"coefficients of other joints, expected the {len(rig.joints)} of {rig.name}")
    try:
        encoded = encode(content)
    except InputError as error:
        raise error.under(target) from None
    # read back, not estimated: the report has what readers of these very bytes get
    read_back = decode(encoded.data, rig.joints, target)
    largest = max(
        float(np.linalg.norm(rig.evaluate(coefficients=one) - rig.evaluate(coefficients=other), axis=1).max())
        for one, other in zip(content.frames, read_back.frames, strict=True)
    )
    write_bytes(target, encoded.data)
    return PayloadReport(
        path=target,
        bytes=len(encoded.data),
        precision=content.precision,
        joints=len(content.joints),
        stored=encoded.stored,
        frames=len(content.frames),
        error_mm=largest * content.meters_per_unit * 1000.0,
        translation_error=encoded.translation_error,
        rotation_error=encoded.rotation_error,
        scale_error=encoded.scale_error,
    )


def payload_bytes(path: Path) -> bytes:
    """The bytes of a payload's file.

    :raises InputError: another suffix, not readable, or larger than any payload
    """
    check_payload_suffix(path)
    return read_bytes(path, _MOST_BYTES)


def check_payload_suffix(path: Path) -> None:
    """:raises InputError: another suffix than .fpb"""
    if path.suffix.lower() != SUFFIX:
        raise InputError(path, f"suffix '{path.suffix}', expected {SUFFIX}")


def limit_warnings(beyond: tuple[str, ...], *, clamped: bool) -> tuple[str, ...]:
    """A line where coefficients are beyond limits."""
    if not beyond:
        return ()
    some = first_names([one.rpartition("/")[2] for one in beyond], _SHOWN)
    done = "brought into" if clamped else "beyond"
    return (f"{len(beyond)} channels {done} the limits of the face: {some}",)


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


def check_fits(face: Face, content: PayloadContent) -> None:
    """:raises InputError: the coefficients are of other joints or in other units than the face"""
    joints = face.skeleton.joints
    if content.joints != joints:
        raise InputError(face.where, f"{len(joints)} joints, expected the {len(content.joints)} of the coefficients")
    if np.float32(content.meters_per_unit) != np.float32(face.meters_per_unit):
        what = f"translations in units of {content.meters_per_unit:g} m, expected {face.meters_per_unit:g} m"
        raise InputError(face.where, what)


def posed_points(face: Face, content: PayloadContent, done: Callable[[], object] = lambda: None) -> FloatArray:
    """(n, 3) or (T, n, 3) float32 world points, in stage units.

    :param done: called after every frame
    :raises InputError: other joints or units than the face has, or points that float32 can't hold
    """
    check_fits(face, content)
    points = np.empty((len(content.frames), len(face.rig().points), 3), np.float32)
    for number, (frame, coefficients) in enumerate(zip(points, content.frames, strict=True)):
        with np.errstate(over="ignore", invalid="ignore"):
            frame[:] = face.evaluate(coefficients=coefficients)
        if not np.isfinite(frame).all():
            what = "points too large for float32, expected smaller coefficients"
            raise InputError(f"{face.where} -> frame {number}", what)
        done()
    return points if np.ndim(content.coefficients) == 3 else points[0]
