"""Whole numbers of joints in few bytes: most are small, and those of a kind of channel are alike."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.payload.range_coder import KINDS_OF_SIZES, BitReader, BitWriter

_EACH = 1 + KINDS_OF_SIZES  # contexts of a kind: whether it is 0, then how large it is
_CONTEXTS = 3 * _EACH


def encode_numbers(numbers: IntArray) -> bytes:
    """The bytes of (j, c) numbers, three channels of each kind."""
    writer = BitWriter(_CONTEXTS)
    for row in numbers.tolist():
        for channel, value in enumerate(row):
            context = channel // 3 * _EACH
            writer.bit(context, value != 0)
            if value:
                writer.number(value < 0, 1)
                writer.size(abs(value), context + 1, 1)
    return writer.bytes()


def decode_numbers(data: bytes, joints: int, channels: int, where: object) -> IntArray:
    """The (j, c) numbers of bytes.

    :raises InputError: bytes that end before the numbers do
    """
    reader, numbers = BitReader(data, _CONTEXTS, where), np.zeros((joints, channels), np.int64)
    for row in numbers:
        for channel in range(channels):
            context = channel // 3 * _EACH
            if reader.bit(context):
                negative = reader.number(1)
                size = reader.size(context + 1, 1)
                row[channel] = -size if negative else size
    return numbers
