"""Payloads of bone coefficients: bytes to arrays, with all that can be wrong refused."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.payload.content import PayloadContent
from facepipe.payload.layout import (
    CRC,
    DTYPES,
    FLOAT32,
    FRAMES,
    HEADER,
    LARGEST,
    LARGEST_UNIT,
    LEAST_UNIT,
    MAGIC,
    MAX_VALUES,
    SPARSE,
    TIMES,
    VERSION,
    Header,
    ascend,
    joints_hash,
    most_values,
)


def read_header(data: bytes, where: object) -> Header:
    """What a payload holds, its size and CRC checked.

    :param where: the payload's name for messages
    :raises InputError: no payload, one of a newer version, or a damaged one
    """
    if not data.startswith(MAGIC):
        raise InputError(where, "no bone coefficients, expected a file that begins with FPBC")
    if len(data) < HEADER.size + CRC.size:
        raise InputError(where, f"{len(data)} bytes, expected at least {HEADER.size + CRC.size}")
    _, version, flags, joints, frames, stored, unit, names = HEADER.unpack_from(data)
    if version != VERSION:
        raise InputError(where, f"version {version}, expected {VERSION}")
    header = Header(
        precision="float32" if flags & FLOAT32 else "float16",
        joints=joints,
        frames=frames,
        stored=stored,
        meters_per_unit=float(str(np.float32(unit))),
        joints_hash=names.hex(),
        has_frames=bool(flags & FRAMES),
        has_times=bool(flags & TIMES),
        is_sparse=bool(flags & SPARSE),
    )
    if len(data) != header.end + CRC.size:
        raise InputError(where, f"{len(data)} bytes, expected {header.end + CRC.size} for what its header counts")
    if zlib.crc32(data[: -CRC.size]) != CRC.unpack_from(data, header.end)[0]:
        raise InputError(where, "is damaged: its CRC differs")
    _check_header(header, flags, where)
    return header


def decode(data: bytes, joints: Sequence[str], where: object) -> PayloadContent:
    """The content of a payload for a skeleton with `joints`.

    :param joints: paths in skeleton order
    :param where: the payload's name for messages
    :raises InputError: as `read_header`, a payload for other joints, or numbers that are not finite or too large
    """
    header = read_header(data, where)
    own = joints_hash(joints).hex()
    if (header.joints, header.joints_hash) != (len(joints), own):
        what = f"made for other joints ({header.joints}, hash {header.joints_hash})"
        raise InputError(where, f"{what}, expected those of this skeleton ({len(joints)}, hash {own})")
    stored = np.frombuffer(data[header.values : header.mask], DTYPES[header.precision])
    if not (np.isfinite(stored) & (np.abs(stored.astype(np.float64)) <= LARGEST)).all():
        raise InputError(where, f"NaN, infinity or a number above {LARGEST:g}, expected finite coefficients")
    values = np.zeros((header.frames, header.joints, 9))
    values[:, _places(data, header, where)] = stored.reshape(header.frames, header.stored, 9)
    values[..., 6:] += 1.0
    return PayloadContent(
        joints=tuple(joints),
        coefficients=values if header.has_frames else values[0],
        times=_times(data, header, where),
        meters_per_unit=header.meters_per_unit,
        precision=header.precision,
    )


def _check_header(header: Header, flags: int, where: object) -> None:
    if flags & ~(FLOAT32 | FRAMES | TIMES | SPARSE):
        raise InputError(where, f"flags {flags:#06x}, expected none above {SPARSE:#06x}")
    if header.has_times and not header.has_frames:
        raise InputError(where, "sample times without frames, expected both or frames alone")
    most = 1 if not header.has_frames else MAX_VALUES
    if not 1 <= header.frames <= most or not 1 <= header.stored <= header.joints:
        what = f"{header.frames} frames of {header.stored} among {header.joints} joints"
        raise InputError(where, f"{what}, expected at least one of each{'' if header.has_frames else ', one frame'}")
    if not header.is_sparse and header.stored != header.joints:
        raise InputError(where, f"{header.stored} joints stored without a mask, expected all {header.joints}")
    most = most_values(header.frames, header.stored)
    if 9 * header.frames * header.joints > most:
        raise InputError(where, f"{header.frames} frames of {header.joints} joints, expected {most} numbers at most")
    if not LEAST_UNIT <= header.meters_per_unit <= LARGEST_UNIT:
        raise InputError(where, f"{header.meters_per_unit} metres a unit, expected a length above 0")


def _places(data: bytes, header: Header, where: object) -> IntArray:
    """(stored,) numbers of the joints in the payload."""
    if not header.is_sparse:
        return np.arange(header.joints)
    bits = np.unpackbits(np.frombuffer(data[header.mask : header.end], np.uint8), bitorder="little")
    places = np.flatnonzero(bits)
    if len(places) != header.stored or places[-1] >= header.joints:
        raise InputError(where, f"joint mask of {len(places)} joints, expected {header.stored} among {header.joints}")
    return places


def _times(data: bytes, header: Header, where: object) -> FloatArray | None:
    if not header.has_times:
        return None
    times = np.frombuffer(data[HEADER.size : header.values], "<f4").astype(np.float64)
    if not ascend(times):
        raise InputError(where, "times don't ascend, expected different seconds in order")
    return times
