"""Named arrays out of an .npz file that may be damaged or hostile.

Unlike `numpy.load`, nothing is allocated before an array's header has been checked against what is expected and
against the size of its archive member, and pickled objects are never read.
"""

from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError

MAX_BYTES = 1 << 30  # of one array
LARGEST = 1e30  # of a number: it and sums of some stay finite in float32, its square in float64

_KINDS = {"float": "f", "int": "iu", "bool": "b", "str": "U"}
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    ValueError,
    TypeError,  # a type that numpy does not have
    OverflowError,
    NotImplementedError,
    RuntimeError,  # encrypted members
    MemoryError,
    LookupError,
)
_HEADER = re.compile(
    r"\{'descr': '(?P<type>[<>|=]?[fiubU][0-9]{1,4})', 'fortran_order': (?P<fortran>True|False), "
    r"'shape': \((?P<shape>(?:[0-9]{1,18}, ?)*(?:[0-9]{1,18})?)\), \}\s*"
)


class Field(NamedTuple):
    """What an array must be: its kind, and a size per axis (a number, a name shared by arrays, or ``name+1``)."""

    kind: Literal["float", "int", "bool", "str"]
    shape: tuple[int | str, ...]


def read_arrays(path: Path, fields: Mapping[str, Field], sizes: dict[str, int]) -> dict[str, npt.NDArray[Any]]:
    """The arrays of `fields`, of native byte order, all numbers finite and at most `LARGEST`.

    :param sizes: values of the size names; names met for the first time are added
    :raises InputError: no readable archive, a missing array, or one of another kind, shape or size
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name: _array(path, archive, name, field, sizes) for name, field in fields.items()}
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise InputError(path, f"is damaged or not an .npz archive ({error})") from error


def _array(path: Path, archive: zipfile.ZipFile, name: str, field: Field, sizes: dict[str, int]) -> npt.NDArray[Any]:
    where = f"{path} -> {name}"
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise InputError(where, "array is missing") from None
    try:
        return _checked(where, _member(where, archive, info, field, sizes))
    except _DAMAGE as error:
        raise InputError(where, f"array is damaged ({error})") from error


def _member(
    where: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo, field: Field, sizes: dict[str, int]
) -> npt.NDArray[Any]:
    with archive.open(info) as stream:
        shape, fortran, dtype = _header(stream)
        _check_header(where, shape, dtype, field, sizes)
        expected = math.prod(shape) * dtype.itemsize
        if expected > MAX_BYTES:
            raise InputError(where, f"array of {expected} bytes, expected at most {MAX_BYTES}")
        data = stream.read(expected + 1)  # one more: reaching the end makes zipfile check the sum
    if len(data) != expected:
        raise InputError(where, f"{len(data)} bytes of data or more, its header says {expected}")
    array = np.frombuffer(data, dtype="u1" if dtype.kind == "b" else dtype)
    array = array != 0 if dtype.kind == "b" else array.astype(dtype.newbyteorder("="))
    return array.reshape(shape, order="F" if fortran else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type of a .npy stream, left at its data (NEP 1, versions 1.0 and 2.0).

    Matched, not evaluated: numpy's own parser runs Python's on whatever text is there.
    """
    magic = stream.read(8)
    if magic[:6] != b"\x93NUMPY" or magic[6:] not in (b"\x01\x00", b"\x02\x00"):
        raise ValueError("no .npy header")
    size = struct.Struct("<H" if magic[6] == 1 else "<I")
    (length,) = size.unpack(stream.read(size.size))
    match = _HEADER.fullmatch(stream.read(min(length, 10_000)).decode("latin-1"))
    if not match:
        raise ValueError("its header doesn't describe a plain array")
    shape = tuple(int(number) for number in match["shape"].split(",") if number.strip())
    return shape, match["fortran"] == "True", np.dtype(match["type"])


def _check_header(
    where: str, shape: tuple[int, ...], dtype: np.dtype[Any], field: Field, sizes: dict[str, int]
) -> None:
    if dtype.kind not in _KINDS[field.kind]:
        raise InputError(where, f"array of type {dtype}, expected {field.kind}")
    wanted = tuple(_size(axis, sizes) for axis in field.shape)
    fits = len(shape) == len(wanted) and all(w in (None, s) for s, w in zip(shape, wanted, strict=True))
    if not fits or any(size < 0 for size in shape):
        named = ", ".join(str(axis if size is None else size) for axis, size in zip(field.shape, wanted, strict=True))
        raise InputError(where, f"array of shape {shape}, expected ({named})")
    for size, axis in zip(shape, field.shape, strict=True):
        if isinstance(axis, str) and axis not in sizes and not axis.endswith("+1"):
            sizes[axis] = size


def _size(axis: int | str, sizes: Mapping[str, int]) -> int | None:
    if isinstance(axis, int):
        return axis
    if axis.endswith("+1"):
        base = sizes.get(axis[:-2])
        return None if base is None else base + 1
    return sizes.get(axis)


def _checked(where: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if array.dtype.kind == "f" and not (np.abs(array) <= LARGEST).all():
        raise InputError(where, f"array holds NaN, infinity or a number over {LARGEST:g}")
    if array.dtype.kind == "U":
        "".join(array.ravel().tolist()).encode()  # code points that are no text raise here
    return array


def check_indices(where: str, indices: npt.NDArray[np.integer], count: int) -> None:
    """Check that every index is in 0..count-1.

    :raises InputError: one is not
    """
    if indices.size and (int(indices.min()) < 0 or int(indices.max()) >= count):
        raise InputError(where, f"index {_outlier(indices, count)} out of range, expected 0..{count - 1}")


def _outlier(indices: npt.NDArray[np.integer], count: int) -> int:
    return int(indices.min()) if int(indices.min()) < 0 else int(indices.max())
