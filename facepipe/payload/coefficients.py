"""Payloads of bone coefficients: arrays to bytes, and back with all that can be wrong refused."""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError

MAGIC = b"FPBC"
VERSION = 1
FLOAT32, FRAMES, TIMES, SPARSE = 1, 2, 4, 8  # flags
LARGEST = 2.0**100  # of a number, about 1.3e30: products of some stay finite
MAX_VALUES = 1 << 27  # of T m 9 numbers, 1 GiB as float64: what a reader allocates for a sound file
FREE_VALUES, PER_STORED = 1 << 23, 32  # of these, beside those at rest: these, and as many for each number stored
LEAST_UNIT, LARGEST_UNIT = 1e-9, 1e9  # metres
Precision = Literal["float16", "float32"]


HEADER = struct.Struct("<4sHHIIIf8s")
CRC = struct.Struct("<I")
DTYPES: dict[Precision, str] = {"float16": "<f2", "float32": "<f4"}
_CHANNELS = ("translation", "rotation", "scale")


def most_values(frames: int, stored: int) -> int:
    """The most numbers that the joints of a skeleton may have, of which some are `stored` in a payload."""
    return min(MAX_VALUES, FREE_VALUES + PER_STORED * 9 * frames * stored)


class Header(NamedTuple):
    """The header of a payload."""

    precision: Precision
    joints: int  # m, of the skeleton
    frames: int  # T
    stored: int  # joints in the payload
    meters_per_unit: float  # the shortest decimal of a float32
    joints_hash: str  # hexadecimal
    has_frames: bool  # coefficients are (T, m, 9), also where T = 1
    has_times: bool
    is_sparse: bool

    @property
    def values(self) -> int:
        """First byte of the coefficients."""
        return HEADER.size + 4 * self.frames * self.has_times

    @property
    def mask(self) -> int:
        """First byte of the joint mask, if there is one."""
        return self.values + 9 * self.frames * self.stored * np.dtype(DTYPES[self.precision]).itemsize

    @property
    def end(self) -> int:
        """First byte of the CRC."""
        return self.mask + (self.joints + 7) // 8 * self.is_sparse


def joints_hash(joints: Sequence[str]) -> bytes:
    """8 bytes that differ between lists of joint paths."""
    return hashlib.sha256("\n".join(joints).encode()).digest()[:8]


def as_stored(coefficients: FloatArray, precision: Precision) -> FloatArray:
    """(..., 9) coefficients as a payload holds them: in its precision, scales as s - 1; infinite where too large."""
    shifted = np.array(coefficients, dtype=np.float64)
    shifted[..., 6:] -= 1.0
    with np.errstate(over="ignore"):
        rounded = shifted.astype(DTYPES[precision])
    return np.asarray(rounded + rounded.dtype.type(0))  # no -0: the same pose is the same bytes


def ascend(times: FloatArray) -> bool:
    """Whether times are finite, and each after the one before."""
    return bool(np.isfinite(times).all() and (np.diff(times) > 0).all())


@dataclass(frozen=True, kw_only=True)
class PayloadContent:
    """Bone coefficients of one pose, of several, or of a clip."""

    joints: tuple[str, ...]  # m paths, in skeleton order
    coefficients: FloatArray  # (m, 9), or (T, m, 9): t (stage units), r (radians), s, relative to rest
    times: FloatArray | None = None  # (T,) seconds, ascending: a clip; None: poses
    meters_per_unit: float  # of the stage that translations are in
    precision: Precision = "float32"

    @property
    def frames(self) -> FloatArray:
        """(T, m, 9) coefficients; T = 1 for a single pose."""
        array = np.asarray(self.coefficients, dtype=np.float64)
        return array if array.ndim == 3 else array[None]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """A payload, and the largest errors that rounding to its precision made."""

    data: bytes
    stored: int  # joints in it
    translation_error: float  # stage units
    rotation_error: float  # radians
    scale_error: float  # factor


def encode(content: PayloadContent) -> Encoded:
    """The payload of `content`; joints that stay at rest in all frames are left out where that is smaller.

    :raises InputError: counts that don't fit, times that don't ascend in float32, or numbers that are not finite or too
        large for the precision
    """
    _check(content)
    exact = content.frames
    # (T, m, 9) numbers as they are stored
    _refuse(content, exact, np.abs(exact) <= LARGEST, f"a finite number of at most {LARGEST:g}")
    rounded = as_stored(exact, content.precision)
    _refuse(content, exact, np.isfinite(rounded), "one that float16 holds (below 65520; or precision float32)")
    moving = np.flatnonzero(rounded.any(axis=(0, 2)))
    moving = moving if moving.size else np.zeros(1, np.intp)  # at rest: a payload stores one joint at least
    count, size = len(content.joints), rounded.dtype.itemsize
    is_sparse = 9 * size * len(exact) * (count - len(moving)) > (count + 7) // 8
    is_sparse &= exact.size <= most_values(len(exact), len(moving))
    stored = rounded[:, moving] if is_sparse else rounded
    flags = FLOAT32 * (content.precision == "float32") | FRAMES * (np.ndim(content.coefficients) == 3)
    flags |= TIMES * (content.times is not None) | SPARSE * is_sparse
    sizes = (count, len(exact), stored.shape[1])
    parts = [HEADER.pack(MAGIC, VERSION, flags, *sizes, content.meters_per_unit, joints_hash(content.joints))]
    parts += [] if content.times is None else [np.asarray(content.times).astype("<f4").tobytes()]
    mask = np.isin(np.arange(count), moving)
    parts += [stored.tobytes(), np.packbits(mask, bitorder="little").tobytes() if is_sparse else b""]
    body = b"".join(parts)
    kept = rounded.astype(np.float64)
    kept[..., 6:] += 1.0
    error = np.abs(kept - exact).max(axis=(0, 1)).reshape(3, 3).max(axis=1)
    return Encoded(
        data=body + CRC.pack(zlib.crc32(body)),
        stored=stored.shape[1],
        translation_error=float(error[0]),
        rotation_error=float(error[1]),
        scale_error=float(error[2]),
    )


def _check(content: PayloadContent) -> None:
    shape, count = np.shape(content.coefficients), len(content.joints)
    if not count or shape[-2:] != (count, 9) or len(shape) not in (2, 3) or 0 in shape:
        expected = f"({count or 'joints'}, 9) or (frames, {count or 'joints'}, 9)"
        raise InputError("bone coefficients", f"array of shape {shape}, expected {expected}, none of them 0")
    if math.prod(shape) > MAX_VALUES:
        raise InputError("bone coefficients", f"{math.prod(shape)} numbers, expected at most {MAX_VALUES}")
    if content.precision not in DTYPES:
        raise InputError("bone coefficients", f"precision '{content.precision}', expected float16 or float32")
    if not LEAST_UNIT <= content.meters_per_unit <= LARGEST_UNIT:
        raise InputError("bone coefficients", f"{content.meters_per_unit} metres a unit, expected a length above 0")
    if content.times is not None:
        if len(shape) != 3 or np.shape(content.times) != shape[:1]:
            raise InputError("bone coefficients", f"times {np.shape(content.times)}, expected one per frame")
        with np.errstate(over="ignore"):
            seconds = np.asarray(content.times).astype("<f4")
        if not ascend(seconds):
            raise InputError("bone coefficients", "times don't ascend, expected different float32 seconds in order")


def _refuse(content: PayloadContent, exact: FloatArray, sound: BoolArray, expected: str) -> None:
    if sound.all():
        return
    frame, joint, channel = np.argwhere(~sound)[0]
    where = f"bone coefficients -> {content.joints[joint]} -> {_CHANNELS[channel // 3]} {'xyz'[channel % 3]}"
    raise InputError(where, f"{exact[frame, joint, channel]:g}, expected {expected}")


def read_header(data: bytes, where: object) -> Header:
    """The header of a payload, its size and CRC checked.

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
    return header


def decode(data: bytes, joints: Sequence[str], where: object) -> PayloadContent:
    """The content of a payload for a skeleton with `joints`.

    :param joints: paths in skeleton order
    :param where: the payload's name for messages
    :raises InputError: as `read_header`, a payload for other joints, or numbers that are not finite or too large
    """
    header = read_header(data, where)
    skeleton_hash = joints_hash(joints).hex()
    if (header.joints, header.joints_hash) != (len(joints), skeleton_hash):
        what = f"made for other joints ({header.joints}, hash {header.joints_hash})"
        raise InputError(where, f"{what}, expected those of this skeleton ({len(joints)}, hash {skeleton_hash})")
    stored = np.frombuffer(data[header.values : header.mask], DTYPES[header.precision])
    with np.errstate(invalid="ignore"):  # casts of NaN
        sound = np.abs(stored.astype(np.float64)) <= LARGEST
    if not sound.all():
        raise InputError(where, f"NaN, infinity or a number above {LARGEST:g}, expected finite coefficients")
    values, places = np.zeros((header.frames, header.joints, 9)), np.arange(header.joints)
    if header.is_sparse:
        bits = np.unpackbits(np.frombuffer(data[header.mask : header.end], np.uint8), bitorder="little")
        places = np.flatnonzero(bits)
        if len(places) != header.stored or places[-1] >= header.joints:
            expected = f"expected {header.stored} among {header.joints}"
            raise InputError(where, f"joint mask of {len(places)} joints, {expected}")
    values[:, places] = stored.reshape(header.frames, header.stored, 9)
    values[..., 6:] += 1.0
    times = None
    if header.has_times:
        times = np.frombuffer(data[HEADER.size : header.values], "<f4").astype(np.float64)
        if not ascend(times):
            raise InputError(where, "times don't ascend, expected different seconds in order")
    return PayloadContent(
        joints=tuple(joints),
        coefficients=values if header.has_frames else values[0],
        times=times,
        meters_per_unit=header.meters_per_unit,
        precision=header.precision,
    )
