"""Whole numbers of joints in few bytes: most are small, and those of a kind of channel are alike."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.payload.range_coder import KINDS_OF_SIZES, BitReader, BitWriter

_CHANNELS = 9  # a joint: three of each kind
_EACH = 1 + KINDS_OF_SIZES  # contexts of a kind: whether it is 0, then how large it is
_CONTEXTS = 3 * _EACH


def encode_numbers(numbers: IntArray) -> bytes:
    """The bytes of (j, 9) numbers."""
    writer = BitWriter(_CONTEXTS)
    for row in numbers.tolist():
        for channel, value in enumerate(row):
            context = channel // 3 * _EACH
            writer.bit(context, value != 0)
            if value:
                writer.number(value < 0, 1)
                writer.size(abs(value), context + 1, 1)
    return writer.bytes()


def decode_numbers(data: bytes, joints: int, where: object) -> IntArray:
    """The (j, 9) numbers of bytes.

    :raises InputError: bytes that end before the numbers do
    """
    reader, numbers = BitReader(data, _CONTEXTS, where), np.zeros((joints, _CHANNELS), np.int64)
    for row in numbers:
        for channel in range(_CHANNELS):
            context = channel // 3 * _EACH
            if reader.bit(context):
                negative = reader.number(1)
                size = reader.size(context + 1, 1)
                row[channel] = -size if negative else size
    return numbers
