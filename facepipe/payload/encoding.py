"""Payloads of bone coefficients: arrays to bytes."""

from __future__ import annotations

import math
import zlib

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.payload.content import Encoded, PayloadContent
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
    as_stored,
    ascend,
    joints_hash,
    most_values,
)

_CHANNELS = ("translation", "rotation", "scale")


def encode(content: PayloadContent) -> Encoded:
    """The payload of `content`; joints that stay at rest in all frames are left out where that is smaller.

    :raises InputError: counts that don't fit, times that don't ascend in float32, or numbers that are not finite or too
        large for the precision
    """
    _check(content)
    exact = content.frames
    rounded = _rounded(content, exact)
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
    parts += [stored.tobytes(), _mask(moving, count) if is_sparse else b""]
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


def _rounded(content: PayloadContent, exact: FloatArray) -> FloatArray:
    """(T, m, 9) numbers as they are stored."""
    _refuse(content, exact, np.abs(exact) <= LARGEST, f"a finite number of at most {LARGEST:g}")
    rounded = as_stored(exact, content.precision)
    _refuse(content, exact, np.isfinite(rounded), "one that float16 holds (below 65520; or precision float32)")
    return rounded


def _refuse(content: PayloadContent, exact: FloatArray, sound: npt.NDArray[np.bool_], expected: str) -> None:
    if sound.all():
        return
    frame, joint, channel = np.argwhere(~sound)[0]
    where = f"bone coefficients -> {content.joints[joint]} -> {_CHANNELS[channel // 3]} {'xyz'[channel % 3]}"
    raise InputError(where, f"{exact[frame, joint, channel]:g}, expected {expected}")


def _mask(moving: IntArray, count: int) -> bytes:
    bits = np.zeros(count, np.uint8)
    bits[moving] = 1
    return np.packbits(bits, bitorder="little").tobytes()
