"""What EXT_meshopt_compression has compressed, decoded.

Source: the glTF extension EXT_meshopt_compression, appendices A (bitstreams) and B (filters).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from facepipe_gltf.buffers import MESHOPT

Bytes = npt.NDArray[np.uint8]

_ATTRIBUTES, _TRIANGLES, _INDICES = 0xA0, 0xE1, 0xD1  # first byte of each kind of data
_GROUP = 16  # elements whose bytes are packed together
_LONGEST_TAIL = 32
_PACKED = {  # bits of an element -> the elements of a byte
    bits: [bytes(byte >> shift & (1 << bits) - 1 for shift in range(8 - bits, -1, -bits)) for byte in range(256)]
    for bits in (2, 4)
}


def decode(data: bytes, count: int, size: int, mode: str, filtered: str = "NONE") -> bytes:
    """The bytes of `count` elements of `size` bytes each.

    :param mode: ATTRIBUTES, TRIANGLES or INDICES
    :param filtered: NONE, OCTAHEDRAL, QUATERNION or EXPONENTIAL
    :raises ValueError: sizes, modes or data that the extension doesn't have
    """
    if mode not in ("ATTRIBUTES", "TRIANGLES", "INDICES") or filtered not in ("NONE", *_FILTERS):
        raise ValueError(f"mode {mode[:20]}, filter {filtered[:20]}, expected ones of {MESHOPT}")
    try:
        if mode == "ATTRIBUTES":
            # (count, size): each byte of an element differs by little from that byte of the element before
            if size % 4 or not 4 <= size <= 256 or data[0] != _ATTRIBUTES:
                raise ValueError(
                    f"elements of {size} bytes or another version, expected a multiple of 4 to 256, version 0"
                )
            end = len(data) - max(size, _LONGEST_TAIL)
            block = min(8192 // size // _GROUP * _GROUP, 256)
            if end < 1 + -(-count // block) * size:  # each byte of each block has a head
                raise ValueError("its data ends too early")
            elements = np.empty((count, size), np.uint8)
            before = np.frombuffer(data, np.uint8, size, len(data) - size)
            at = 1
            for first in range(0, count, block):
                rows = min(block, count - first)
                groups = -(-rows // _GROUP)
                differences = np.zeros((size, groups * _GROUP), np.uint8)
                for lane in differences:
                    at = _lane(data, at, groups, lane)
                signed = (differences >> 1) ^ -(differences & 1)
                signed[:, 0] += before
                np.cumsum(signed[:, :rows], axis=1, dtype=np.uint8, out=differences[:, :rows])
                elements[first : first + rows] = differences[:, :rows].T
                before = elements[first + rows - 1]
                if at > end:
                    raise ValueError("its data ends too early")
            return (elements if filtered == "NONE" else _FILTERS[filtered](elements)).tobytes()
        if size not in (2, 4) or (mode == "TRIANGLES" and count % 3):
            raise ValueError(f"{count} indices of {size} bytes, expected triangles of 2 or 4")
        indices = np.array((_triangles if mode == "TRIANGLES" else _indices)(data, count), np.int64)
        # indices are coded as differences and may run out of range: astype would wrap them without a word
        if count and (indices.min() < 0 or indices.max() >= 1 << 8 * size):
            raise ValueError(f"an index beyond {size} bytes")
        return indices.astype(f"<u{size}").tobytes()
    except IndexError:
        raise ValueError("its data ends too early") from None


def _lane(data: bytes, at: int, groups: int, lane: Bytes) -> int:
    """Reads one byte of the elements of a block into `lane`; the position of the next byte's data."""
    heads = data[at : at + -(-groups // 4)]
    at += len(heads)
    if not any(heads):
        return at
    for group in range(groups):
        bits = (0, 2, 4, 8)[heads[group // 4] >> group % 4 * 2 & 3]
        if not bits:
            continue
        packed = data[at : at + 2 * bits]
        at += 2 * bits
        values = bytearray(packed if bits == 8 else b"".join([_PACKED[bits][byte] for byte in packed]))
        if bits < 8:  # the largest value stands for a byte that follows
            escape, place = (1 << bits) - 1, -1
            while (place := values.find(escape, place + 1)) >= 0:
                values[place] = data[at]
                at += 1
        lane[group * _GROUP : (group + 1) * _GROUP] = np.frombuffer(values, np.uint8, _GROUP)
    return at


class _Numbers:
    """Whole numbers of 7 bits a byte, each the difference to one before."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self._at = at

    def byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def number(self) -> int:
        result = shift = 0
        while shift < 35:
            byte = self.byte()
            result |= (byte & 127) << shift
            if byte < 128:
                break
            shift += 7
        return result


def _signed(number: int) -> int:
    return number >> 1 ^ -(number & 1)


def _indices(data: bytes, count: int) -> list[int]:
    if data[0] != _INDICES or len(data) < 1 + count + 4:
        raise ValueError(f"{len(data)} bytes of another version or for fewer than {count} indices")
    numbers = _Numbers(data, 1)
    last = [0, 0]
    result = []
    for _ in range(count):
        number = numbers.number()
        last[number & 1] += _signed(number >> 1)
        result.append(last[number & 1])
    return result


def _triangles(data: bytes, count: int) -> list[int]:
    """Triangles share edges with those before, and vertices are new ones in turn or recent ones."""
    codes = count // 3
    if data[0] != _TRIANGLES or len(data) < 1 + codes + 16:
        raise ValueError(f"{len(data)} bytes of another version or for fewer than {codes} triangles")
    numbers, table = _Numbers(data, 1 + codes), data[-16:]
    edges, vertices = deque([(0, 0)] * 16, 16), deque([0] * 16, 16)  # the last ones, the latest first
    fresh = last = 0
    result: list[int] = []

    def corner(code: int, *, steps: int) -> int:
        """A new vertex, one `steps` back, or one by its number."""
        nonlocal fresh, last
        if code == 15:
            last += _signed(numbers.number())
        if 0 < code < 15:
            return vertices[steps]
        fresh += code == 0
        return last if code == 15 else fresh - 1

    for code in data[1 : 1 + codes]:
        high, low = code >> 4, code & 15
        if high < 15:
            a, b = edges[high]
            if low in (13, 14):
                last += 1 if low == 14 else -1
                c = last
            else:
                c = corner(low, steps=low)
            if low == 0 or low >= 13:
                vertices.appendleft(c)
            edges.appendleft((c, b))
            edges.appendleft((a, c))
        else:
            pair = table[low] if low < 14 else numbers.byte()
            if low >= 14 and pair == 0:
                fresh = 0
            kinds = (15 if low == 15 else 0, pair >> 4, pair & 15)
            # neither of the three is pushed before all are known
            a, b, c = (corner(kind, steps=kind - 1) for kind in kinds)
            for kind, vertex in zip(kinds, (a, b, c), strict=True):
                if kind in (0, 15):
                    vertices.appendleft(vertex)
            edges.appendleft((b, a))
            edges.appendleft((c, b))
            edges.appendleft((a, c))
        result += (a, b, c)
    return result


def _octahedral(elements: Bytes) -> npt.NDArray[np.generic]:
    """Unit vectors from the octahedron that they are folded onto; the fourth component stays."""
    if elements.shape[1] not in (4, 8):
        raise ValueError(f"octahedral elements of {elements.shape[1]} bytes, expected 4 or 8")
    kind, largest = ("<i1", 127) if elements.shape[1] == 4 else ("<i2", 32767)
    values: npt.NDArray[np.float64] = elements.view(kind).astype(np.float64)
    x, y, one = values[:, 0], values[:, 1], values[:, 2]
    z = one - np.abs(x) - np.abs(y)
    below = np.minimum(z, 0)
    xyz = np.stack([x + np.where(x >= 0, below, -below), y + np.where(y >= 0, below, -below), z], axis=1)
    length = np.linalg.norm(xyz, axis=1, keepdims=True)
    values[:, :3] = _rounded(xyz * largest / np.where(length == 0, 1, length))
    return values.astype(kind)


def _quaternion(elements: Bytes) -> npt.NDArray[np.generic]:
    """Unit quaternions without their largest component, whose number and scale are in the fourth."""
    if elements.shape[1] != 8:
        raise ValueError(f"quaternions of {elements.shape[1]} bytes, expected 8")
    values = elements.view("<i2").astype(np.int64)
    scale = np.sqrt(0.5) / (values[:, 3] | 3)
    xyz = values[:, :3] * scale[:, None]
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
    all_four = _rounded(32767 * np.concatenate([w[:, None], xyz], axis=1))
    places = ((values[:, 3] & 3)[:, None] + np.arange(4)) & 3
    result = np.empty_like(all_four)
    np.put_along_axis(result, places, all_four, axis=1)
    return result.astype("<i2")


def _exponential(elements: Bytes) -> npt.NDArray[np.generic]:
    """Floats from 8 bits of exponent and 24 of mantissa."""
    values = elements.view("<i4")
    return np.asarray(np.ldexp((values << 8) >> 8, values >> 24), "<f4")


def _rounded(values: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """The nearest whole numbers, halves away from zero."""
    return np.trunc(np.asarray(values + np.copysign(0.5, values), np.float64))


_FILTERS: dict[str, Callable[[Bytes], npt.NDArray[np.generic]]] = {
    "OCTAHEDRAL": _octahedral,
    "QUATERNION": _quaternion,
    "EXPONENTIAL": _exponential,
}
