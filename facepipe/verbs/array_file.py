"""Named arrays and a JSON text in one file, in the layout of safetensors, with a digest of all of it.

Eight bytes (little-endian) count those of a JSON header, then comes the header, then the arrays. The header says type,
shape and place of each array, and under ``__metadata__`` holds texts: our ``format``, ``content`` (JSON), and the
``sha256`` of the file, taken with zeros in its own place. Nothing in it is code; any reader of safetensors opens it.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import AnyArray
from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.core.reading import check_values, read_bytes

MAX_BYTES = 1 << 34  # of a file
_MAX_HEADER = 1 << 26
_SIZE = struct.Struct("<Q")
_TYPES = {"F32": "<f4", "F64": "<f8", "I32": "<i4"}
_CODES = {np.dtype(code).str: name for name, code in _TYPES.items()}
_NO_SUM = "0" * 64
_LARGEST = 1e12  # of a number: squares of some stay finite in float32


class Content(NamedTuple):
    """What is in a file."""

    arrays: Mapping[str, AnyArray]
    content: dict[str, Any]  # the JSON


def write_arrays(path: Path, kind: str, content: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> None:
    """Write a file atomically: the same arrays and content are the same bytes.

    :param kind: the format, with its version
    :raises InputError: NaN, infinity or a number too large, or a file that can't be written
    """
    stored: dict[str, AnyArray] = {}
    places: dict[str, Any] = {}
    end = 0
    for name in sorted(arrays):
        of_kind = {"f": "<f8", "i": "<i4"}[arrays[name].dtype.kind] if arrays[name].dtype != np.float32 else "<f4"
        array = np.ascontiguousarray(arrays[name], dtype=of_kind)
        _check_numbers(f"{path} -> {name}", array)
        # plus 0 there is no -0: the same content, the same bytes
        stored[name] = array = array + array.dtype.type(0) if array.dtype.kind == "f" else array
        places[name] = {"data_offsets": [end, end + array.nbytes], "dtype": _CODES[array.dtype.str]}
        places[name]["shape"] = list(array.shape)
        end += array.nbytes
    text = _json({"__metadata__": {"content": _json(content), "format": kind, "sha256": _NO_SUM}, **places}).encode()
    text += b" " * (-len(text) % 8)
    head = _SIZE.pack(len(text)) + text
    digest = hashlib.sha256(head)
    for array in stored.values():
        digest.update(array.reshape(-1).data)
    key = '"sha256":"'  # with its quotes bare it is nowhere else: those within the content are escaped
    head = head.replace(f"{key}{_NO_SUM}".encode(), f"{key}{digest.hexdigest()}".encode(), 1)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(head)
        for array in stored.values():
            file.write(array.reshape(-1).data)


def _json(value: Mapping[str, Any]) -> str:
    plain = np.generic.item  # numbers of numpy
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, default=plain)


def read_arrays(path: Path, kind: str) -> Content:
    """What `write_arrays` wrote, arrays read-only and finite.

    :raises InputError: no such file, another format, or a damaged one
    """
    data = read_bytes(path, MAX_BYTES)
    problem = f"is no {kind.removeprefix('facepipe ').rpartition(' ')[0]}"  # without its version
    size = _SIZE.unpack_from(data)[0] if len(data) >= _SIZE.size else 0
    if not 2 <= size <= min(_MAX_HEADER, len(data) - _SIZE.size):
        raise InputError(path, f"{problem}, or cut short")
    start = _SIZE.size + size
    text = data[_SIZE.size : start]
    check_values(path, text)
    try:
        head = json.loads(text.decode())
    except (ValueError, RecursionError):
        raise InputError(path, f"{problem}, or damaged: its header is no JSON") from None
    if not isinstance(head, dict):
        raise InputError(path, f"{problem}: its header is no object")
    metadata = head.pop("__metadata__", None)
    if not isinstance(metadata, dict) or not isinstance(metadata.get("format"), str):
        raise InputError(path, f"has no format, expected {kind}")
    if metadata["format"] != kind:
        raise InputError(path, f"is of format '{metadata['format'][:60]}', expected {kind}")
    # a digest finds damage, not malice (whoever forges a file forges it too): all after it still distrusts the header
    expected = metadata.get("sha256")
    sum_ = expected.encode() if isinstance(expected, str) and len(expected) == len(_NO_SUM) else b""
    place = data.find(sum_) if sum_ else -1
    if place < 0:
        raise InputError(path, "is damaged: no sum of its bytes")
    digest = hashlib.sha256(data[:place] + _NO_SUM.encode())
    digest.update(memoryview(data)[place + len(_NO_SUM) :])
    if digest.hexdigest().encode() != sum_:
        raise InputError(path, "is damaged: its bytes don't have the sum that it states")
    try:
        content = json.loads(metadata["content"])
        arrays = _arrays(path, memoryview(data)[start:], head)
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise InputError(path, f"is damaged: {type(error).__name__} in its header") from None
    if not isinstance(content, dict):
        raise InputError(path, "is damaged: its content is no object")
    return Content(arrays, content)


def _arrays(path: Path, data: memoryview, places: Mapping[str, Any]) -> dict[str, AnyArray]:
    arrays: dict[str, AnyArray] = {}
    end = 0
    for name in sorted(places):
        place, where = places[name], f"{path} -> {name}"
        shape = place["shape"]
        first, last = place["data_offsets"]
        # not isinstance: JSON's true is an int to Python; two negative sizes have a positive product
        if not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError
        dtype = np.dtype(_TYPES[place["dtype"]])
        # each array starts where the last one ended: none overlap, and no bytes hide between them
        if first != end or last - first != math.prod(shape) * dtype.itemsize:
            raise InputError(where, "bytes that don't fit its shape, expected arrays one after another")
        end = last
        if end > len(data):
            raise InputError(where, "ends after the file")
        arrays[name] = np.frombuffer(data[first:last], dtype).reshape(shape)
        _check_numbers(where, arrays[name])
    if end != len(data):
        raise InputError(path, f"{len(data)} bytes of arrays, expected {end}")
    return arrays


def _check_numbers(where: str, array: AnyArray) -> None:
    if array.dtype.kind != "f":
        return
    flat = array.reshape(-1)
    for start in range(0, len(flat), 1 << 22):  # in pieces: no mask as large as the array
        if not (np.abs(flat[start : start + (1 << 22)]) <= _LARGEST).all():
            raise InputError(where, f"NaN, infinity or a number over {_LARGEST:g}")
