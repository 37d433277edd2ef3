"""Files of bone coefficients (.fpb), and what their rounding does to a face."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facepipe.core.atomic import write_bytes
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.core.reports import Report
from facepipe.payload import PayloadContent, decode, encode
from facepipe.rig import Rig

SUFFIX = ".fpb"
MAX_BYTES = 1 << 30


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
    return read_bytes(path, MAX_BYTES)


def check_payload_suffix(path: Path) -> None:
    """:raises InputError: another suffix than .fpb"""
    if path.suffix.lower() != SUFFIX:
        raise InputError(path, f"suffix '{path.suffix}', expected {SUFFIX}")
