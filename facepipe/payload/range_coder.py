"""Bits to bytes by how likely each is: an adaptive binary range coder.

That of LZMA (Igor Pavlov; G. Martin, "Range encoding", 1979) with probabilities of 16 bits, which learn fast at first:
each bit of a context moves its probability by 1/2, 1/4, 1/8, 1/16 and from then on 1/32 of the way. All numbers are
integers, so that every reader gets the same bits.
"""

from __future__ import annotations

from facepipe.core.errors import InputError

_ONE = 1 << 16  # the probability 1
_HALF = 1 << 15  # where each context begins
_SLOWEST = 5  # shift of a context that has seen bits enough
_BITS = 12  # of a probability that divide the range
_TOP, _FULL = 1 << 24, (1 << 32) - 1
_MARGIN = 4  # bytes of the last number; a writer leaves out the zeros that it ends in
_LARGEST = 15  # bits of a number: 32767 at most
_LONG = 14  # of a size, which is counted one by one up to here
KINDS_OF_SIZES = 6  # contexts of a size


def _split(span: int, likely: int) -> int:
    """The part of the range that a 0 takes."""
    return (span >> _BITS) * max(likely >> (16 - _BITS), 1)


class _Contexts:
    """How likely a 0 is in each context."""

    def __init__(self, count: int) -> None:
        self.likely = [_HALF] * count
        self.shifts = [1] * count

    def learn(self, context: int, bit: int) -> None:
        shift = self.shifts[context]
        if bit:
            self.likely[context] -= self.likely[context] >> shift
        else:
            self.likely[context] += (_ONE - 1 - self.likely[context]) >> shift
        if shift < _SLOWEST:
            self.shifts[context] = shift + 1


class BitWriter:
    """Writes bits, each in one of `count` contexts."""

    def __init__(self, count: int) -> None:
        self._contexts = _Contexts(count)
        self._low, self._span = 0, _FULL
        self._out = bytearray()

    def bit(self, context: int, bit: int) -> None:
        """Write a bit of a context: `_split` and `learn` in place, as in `zeros`; calls take as long again."""
        likely, shifts = self._contexts.likely, self._contexts.shifts
        chance, shift = likely[context], shifts[context]
        bound = (self._span >> _BITS) * (chance >> (16 - _BITS) or 1)
        if bit:
            self._low += bound
            self._span -= bound
            likely[context] = chance - (chance >> shift)
        else:
            self._span = bound
            likely[context] = chance + ((_ONE - 1 - chance) >> shift)
        if shift < _SLOWEST:
            shifts[context] = shift + 1
        if self._span < _TOP:
            self._normalise()

    def zeros(self, contexts: list[int]) -> None:
        """Write a 0 of each context, as `bit` does: most points stay, and a call each would take four times as long."""
        likely, shifts, span = self._contexts.likely, self._contexts.shifts, self._span
        for context in contexts:
            chance, shift = likely[context], shifts[context]
            span = (span >> _BITS) * (chance >> (16 - _BITS) or 1)
            likely[context] = chance + ((_ONE - 1 - chance) >> shift)
            if shift < _SLOWEST:
                shifts[context] = shift + 1
            if span < _TOP:
                self._span = span
                self._normalise()
                span = self._span
        self._span = span

    def number(self, value: int, bits: int) -> None:
        """Write a number of some bits, all values alike."""
        for place in range(bits - 1, -1, -1):
            self._span >>= 1
            if value >> place & 1:
                self._low += self._span
            self._normalise()

    def growing(self, value: int) -> None:
        """Write a number of 0 or more, small ones in fewer bits (Exp-Golomb)."""
        length = (value + 1).bit_length()
        for _ in range(length - 1):
            self.number(1, 1)
        self.number(0, 1)
        self.number(value + 1 - (1 << (length - 1)), length - 1)

    def size(self, size: int, context: int, stride: int) -> None:
        """Write a number of 1 or more in KINDS_OF_SIZES contexts, each a stride from the one before."""
        for count in range(1, min(size, _LONG) + (size < _LONG)):
            self.bit(context + (min(count, KINDS_OF_SIZES) - 1) * stride, size > count)
        if size >= _LONG:
            self.growing(size - _LONG)

    def bytes(self) -> bytes:
        """All that was written. Nothing is written after it."""
        # of all numbers that stand for it, the one that ends in most zeros, which are left out
        for places in range(32, -1, -1):
            mask = (1 << places) - 1
            value = (self._low + mask) & ~mask
            if value < self._low + self._span:
                break
        self._low, last = value, len(self._out)
        for _ in range(_MARGIN):
            self._shift()
        return bytes(self._out[:last] + self._out[last:].rstrip(b"\0"))

    def _normalise(self) -> None:
        while self._span < _TOP:
            self._span = self._span << 8 & _FULL
            self._shift()

    def _shift(self) -> None:
        """Move the top byte out; what overflowed is carried into those before."""
        if self._low >> 32:
            place = len(self._out) - 1
            while self._out[place] == 0xFF:
                self._out[place] = 0
                place -= 1
            self._out[place] += 1
        self._out.append(self._low >> 24 & 0xFF)
        self._low = (self._low & (_TOP - 1)) << 8


class BitReader:
    """Reads what a `BitWriter` of as many contexts wrote.

    :raises InputError: it is asked for more than was written
    """

    def __init__(self, data: bytes, count: int, where: object) -> None:
        self._contexts, self._where = _Contexts(count), where
        self._data, self._place, self._span = data + bytes(_MARGIN), 4, _FULL
        self._code = int.from_bytes(self._data[:4], "big")

    def bit(self, context: int) -> int:
        """The next bit, of a context."""
        bound = _split(self._span, self._contexts.likely[context])
        if self._code < bound:
            self._span, bit = bound, 0
        else:
            self._code -= bound
            self._span, bit = self._span - bound, 1
        self._contexts.learn(context, bit)
        if self._span < _TOP:
            self._fill()
        return bit

    def number(self, bits: int) -> int:
        """The next number of some bits."""
        value = 0
        for _ in range(bits):
            self._span >>= 1
            value <<= 1
            if self._code >= self._span:
                self._code -= self._span
                value |= 1
            if self._span < _TOP:
                self._fill()
        return value

    def growing(self) -> int:
        """The next number of 0 or more."""
        length = 0
        while self.number(1):
            length += 1
            if length > _LARGEST:
                raise InputError(self._where, f"a number of more than {_LARGEST} bits, expected small ones")
        return (1 << length) - 1 + self.number(length)

    def size(self, context: int, stride: int) -> int:
        """The next number that `BitWriter.size` wrote."""
        size = 1
        while size < _LONG and self.bit(context + (min(size, KINDS_OF_SIZES) - 1) * stride):
            size += 1
        return size + self.growing() if size == _LONG else size

    def _fill(self) -> None:
        while self._span < _TOP:
            if self._place == len(self._data):
                raise InputError(self._where, "ends in the middle, expected more bytes")
            self._span = self._span << 8 & _FULL
            self._code = (self._code << 8 | self._data[self._place]) & _FULL
            self._place += 1
