"""The bytes of a section one after another, every count checked before memory is taken."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import IntArray
from facepipe.core.errors import InputError

Planes = npt.NDArray[np.uint8]


def planes(values: npt.NDArray[Any], count: int) -> bytes:
    """Whole numbers as `count` planes of bytes, the low ones first, small numbers of either sign small."""
    wide = np.ascontiguousarray(values, np.int64).ravel()
    folded = (wide << 1) ^ (wide >> 63)
    return b"".join((folded >> 8 * i & 0xFF).astype(np.uint8).tobytes() for i in range(count))


def unfolded(bytes_of: Planes) -> IntArray:
    """(n,) the numbers of planes (count, n) of bytes."""
    folded = np.zeros(bytes_of.shape[1], np.int64)
    for i, plane in enumerate(bytes_of):
        folded |= plane.astype(np.int64) << 8 * i
    return np.asarray((folded >> 1) ^ -(folded & 1))


class SectionBytes:
    """Reads a section."""

    def __init__(self, kind: int, data: bytes, where: object) -> None:
        self.kind, self.data, self._where = kind, data, where
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that follow."""
        return len(self.data) - self._at

    def take(self, count: int) -> bytes:
        """The next bytes.

        :raises InputError: fewer are there; as the others
        """
        if count > self.left:
            raise self.wrong(f"{len(self.data)} bytes, expected {count} after {self._at}")
        self._at += count
        return self.data[self._at - count : self._at]

    def numbers(self, kind: str, count: int) -> npt.NDArray[Any]:
        """(count,) of a dtype."""
        return np.frombuffer(self.take(count * np.dtype(kind).itemsize), kind)

    def planes(self, count: int, planes: int) -> IntArray:
        """(count,) whole numbers of planes of bytes."""
        return unfolded(np.frombuffer(self.take(count * planes), np.uint8).reshape(planes, count))

    def text(self, data: bytes) -> str:
        """A name."""
        try:
            return data.decode()
        except UnicodeDecodeError:
            raise self.wrong("a name that is no UTF-8") from None

    def end(self) -> None:
        """:raises InputError: bytes follow"""
        if self.left:
            raise self.wrong(f"{len(self.data)} bytes, expected {self._at}")

    def wrong(self, what: str) -> InputError:
        """The error of a section."""
        return InputError(f"{self._where} -> section of kind {self.kind}", what)
