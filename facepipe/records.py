"""Parts as JSON and back, by the types of their fields: arrays beside, fields at their default left out.

Arrays are in few bytes: one after another, each found by where it begins, in an order of bytes that deflates well.
A float array is stored byte plane by byte plane, an integer array as steps from number to number: most of what goes
along with a face is smooth, sorted or zero, and deflates to little that way.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError

Part = TypeVar("Part")
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
        # float64 only where float32 does not hold the numbers
        if array.dtype == np.int8:
            kind = "b"
        elif array.dtype.kind != "f":
            kind = "i"
        else:
            kind = "f" if np.array_equal(array.astype(np.float32).astype(np.float64), array) else "d"
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


def to_json(value: object, arrays: ArrayWriter) -> Any:
    """Dataclasses, mappings, sequences, arrays, text and numbers as JSON; bytes as hexadecimal text."""
    if isinstance(value, np.ndarray):
        return arrays.reference(value)
    if dataclasses.is_dataclass(value):
        fields = [(field, getattr(value, field.name)) for field in dataclasses.fields(value)]
        return {one.name: to_json(inner, arrays) for one, inner in fields if not _is_default(one, inner)}
    if isinstance(value, Mapping):
        return {str(key): to_json(inner, arrays) for key, inner in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(inner, arrays) for inner in value]
    if isinstance(value, bytes):
        return value.hex()
    return value.item() if isinstance(value, np.generic) else value


def _is_default(field: dataclasses.Field[Any], value: object) -> bool:
    default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    if isinstance(value, np.ndarray) and isinstance(default, np.ndarray):
        return np.array_equal(value, default)
    return type(value) is type(default) and not dataclasses.is_dataclass(value) and bool(value == default)


def from_json(kind: type[Part], data: object, arrays: ArrayReader, where: str) -> Part:
    """The `kind` of part that `to_json` wrote.

    :raises InputError: an unknown, missing or unfit field of `kind`
    """
    result: Part = _read(kind, data, arrays, where)
    return result


def _read(kind: Any, data: Any, arrays: ArrayReader, where: str) -> Any:
    is_part: bool = dataclasses.is_dataclass(kind)
    if is_part:
        if not isinstance(data, dict):
            raise InputError(where, "no object, expected one")
        hints = _hints(kind)
        unknown = sorted(set(data) - set(hints))
        if unknown:
            raise InputError(where, f"unknown field '{ascii(unknown[0])[1:40]}': made by a newer version?")
        values = {name: _read(hints[name], inner, arrays, f"{where}.{name}") for name, inner in data.items()}
        try:
            return kind(**values)
        except TypeError:
            raise InputError(where, "lacks a value") from None
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return arrays.array(data, where)
    if origin in (Union, types.UnionType):
        # the first kind that fits; of several none reads what another is meant to
        problem = InputError(where, "a value of the wrong kind")
        for one in arguments:
            try:
                return _read(one, data, arrays, where)
            except InputError as error:
                problem = error
        raise problem
    if origin is tuple and isinstance(data, list):
        kinds = arguments[:1] * len(data) if arguments[-1] is ... else arguments
        if len(kinds) == len(data):
            pairs = enumerate(zip(kinds, data, strict=True))
            return tuple(_read(one, item, arrays, f"{where}[{i}]") for i, (one, item) in pairs)
    elif origin is not None and origin is not Literal and issubclass(origin, Mapping) and isinstance(data, dict):
        return {key: _read(arguments[1], item, arrays, f"{where}.{key}"[:200]) for key, item in data.items()}
    elif kind is bytes and isinstance(data, str) and not set(data) - set("0123456789abcdef") and len(data) % 2 == 0:
        return bytes.fromhex(data)
    elif _is_plain(kind, origin, arguments, data):
        return float(data) if kind is float else data
    raise InputError(where, "a value of the wrong kind")


def _is_plain(kind: Any, origin: Any, arguments: tuple[Any, ...], data: object) -> bool:
    if origin is Literal:
        return isinstance(data, str) and data in arguments
    if kind is object:
        return True
    if kind is float:
        return isinstance(data, int | float) and not isinstance(data, bool) and math.isfinite(data)
    if kind is int:
        return isinstance(data, int) and not isinstance(data, bool)
    if kind is str:
        return isinstance(data, str) and not any("\ud800" <= one <= "\udfff" for one in data)
    return kind in (bool, type(None)) and isinstance(data, kind)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)
