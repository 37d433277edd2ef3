"""The layout of a payload: header, where what stands, and what is sound.

It is in docs/files.md, "Bone coefficients (.fpb)". Numbers are little-endian; scales are stored as s - 1, so that rest
is all zeros and half precision is spent where faces need it.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray

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
