"""Arrays in few bytes: one after another, each found by where it begins, in an order of bytes that deflates well.

A float array is stored byte plane by byte plane, an integer array as steps from number to number: most of what goes
along with a face is smooth, sorted or zero, and deflates to little that way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError

AnyArray = npt.NDArray[Any]
Json = dict[str, Any]

_KINDS: dict[str, np.dtype[Any]] = {
    "b": np.dtype(np.int8),
    "i": np.dtype("<i4"),
    "f": np.dtype("<f4"),
    "d": np.dtype("<f8"),
}


class ArrayWriter:
    """Collects arrays; `reference` is how JSON names each."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._size = 0

    def reference(self, array: AnyArray) -> Json | list[Any]:
        """Add an array of float or int numbers; its kind, first byte and shape, or [] for an empty list."""
        if array.shape == (0,):
            return []
        kind = _kind_of(array)
        flat = np.ascontiguousarray(array).astype(_KINDS[kind]).ravel()
        if kind == "i":
            flat = np.diff(flat, prepend=np.int32(0)).astype(_KINDS["i"])
        planes = flat.view(np.uint8).reshape(-1, flat.itemsize).T
        result = {"array": [kind, self._size, list(np.shape(array))]}
        self._chunks.append(planes.tobytes())
        self._size += planes.size
        return result

    def finish(self) -> bytes:
        """All arrays."""
        return b"".join(self._chunks)


def _kind_of(array: AnyArray) -> str:
    """float64 only where float32 does not hold the numbers."""
    if array.dtype == np.int8:
        return "b"
    if array.dtype.kind != "f":
        return "i"
    return "f" if np.array_equal(array.astype(np.float32).astype(np.float64), array) else "d"


class ArrayReader:
    """Arrays of a block, by their references."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def array(self, reference: object, where: str) -> AnyArray:
        """The array that `reference` names.

        :raises InputError: no reference, or one to what is not in the block
        """
        if reference == []:
            return np.zeros(0)
        entry = reference.get("array") if isinstance(reference, dict) else None
        if not (isinstance(entry, list) and [type(one) for one in entry] == [str, int, list] and entry[0] in _KINDS):
            raise InputError(where, "no reference to an array, expected one")
        kind, start, shape = _KINDS[entry[0]], entry[1], entry[2]
        if not all(isinstance(one, int) and not isinstance(one, bool) and 0 <= one < 2**31 for one in (start, *shape)):
            raise InputError(where, "an array without a place and size, expected whole numbers")
        count = 1
        for one in shape:
            count *= one
        end = start + count * kind.itemsize
        if len(shape) > 3 or end > len(self._data):
            raise InputError(where, f"an array that ends at byte {end} of {len(self._data)}")
        planes = np.frombuffer(self._data, np.uint8, end - start, start).reshape(kind.itemsize, count)
        flat: AnyArray = np.frombuffer(np.ascontiguousarray(planes.T).tobytes(), kind)
        if kind == _KINDS["i"]:
            flat = np.cumsum(flat, dtype=np.int32)
        return np.asarray(flat.reshape(shape))
