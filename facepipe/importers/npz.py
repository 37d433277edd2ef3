"""Named arrays out of an .npz file that may be damaged or hostile.

Unlike `numpy.load`, nothing is allocated before the headers of all arrays have been checked against what is expected,
and their sum against the size of the file: a small archive must not unfold into gigabytes. Pickled objects are never
read.
"""

from __future__ import annotations

import math
import re
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.reading import check_regular

MAX_BYTES = 1 << 30  # of a file
FREE_BYTES, PER_BYTE = 1 << 26, 8  # of arrays together: these, and as many for each byte of the file
_MOST_TEXTS = 100_000  # of one array: Python keeps each as an object
_MOST_DIRECTORY = 1 << 20  # bytes of the archive's directory, which zipfile takes ten times the memory for
LARGEST = 1e30  # of a number: it and sums of some stay finite in float32, its square in float64

_END, _LOCATOR = struct.Struct("<4s8xI4xH"), 20  # of a zip: the end of its directory; bytes of that of zip64
_PIECE = 1 << 20
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
    with _opened(path) as archive:
        members = {name: _member(path, archive, name, field, sizes) for name, field in fields.items()}
        total = sum(math.prod(member.shape) * member.dtype.itemsize for member in members.values())
        most = FREE_BYTES + PER_BYTE * path.stat().st_size
        if total > most:
            raise InputError(path, f"arrays of {total} bytes, expected at most {most} in a file of its size")
        return {name: _array(f"{path} -> {name}", archive, one) for name, one in members.items()}


def array_names(path: Path) -> set[str]:
    """The names of the arrays in a file.

    :raises InputError: no readable archive
    """
    with _opened(path) as archive:
        return {one.removesuffix(".npy") for one in archive.namelist()}


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    check_regular(path, MAX_BYTES)
    try:
        # refuse an archive whose directory is large, or not where numpy has it: at the end, without comment or zip64
        with path.open("rb") as file:
            file.seek(-min(_END.size + _LOCATOR, path.stat().st_size), 2)
            tail = file.read()
        if len(tail) < _END.size:
            raise zipfile.BadZipFile("too short")
        magic, size, comment = _END.unpack(tail[-_END.size :])
        if magic != b"PK\5\6" or comment or tail[: -_END.size].startswith(b"PK\6\7"):
            raise zipfile.BadZipFile("no directory at its end")
        if size > _MOST_DIRECTORY:
            raise zipfile.BadZipFile(f"directory of {size} bytes, expected at most {_MOST_DIRECTORY}")
        with zipfile.ZipFile(path) as archive:
            yield archive
    except OSError as error:
        raise InputError(path, f"can't be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise InputError(path, f"is damaged or not an .npz archive ({error})") from error


class _Member(NamedTuple):
    """An array that an archive holds, its header checked."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]


def _member(path: Path, archive: zipfile.ZipFile, name: str, field: Field, sizes: dict[str, int]) -> _Member:
    where = f"{path} -> {name}"
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise InputError(where, "array is missing") from None
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(where, f"compressed by method {info.compress_type}, expected stored or deflated")
    try:
        with archive.open(info) as stream:
            shape, fortran, dtype = _header(stream)
    except _DAMAGE as error:
        raise InputError(where, f"array is damaged ({error})") from error
    if dtype.kind not in _KINDS[field.kind]:
        raise InputError(where, f"array of type {dtype}, expected {field.kind}")
    known = {**sizes, **{f"{base}+1": size + 1 for base, size in sizes.items()}}
    wanted = tuple(axis if isinstance(axis, int) else known.get(axis) for axis in field.shape)
    fits = len(shape) == len(wanted) and all(w in (None, s) for s, w in zip(shape, wanted, strict=True))
    if not fits or any(size < 0 for size in shape):
        named = ", ".join(str(axis if size is None else size) for axis, size in zip(field.shape, wanted, strict=True))
        raise InputError(where, f"array of shape {shape}, expected ({named})")
    for size, axis in zip(shape, field.shape, strict=True):
        if isinstance(axis, str) and axis not in sizes and not axis.endswith("+1"):
            sizes[axis] = size
    if dtype.kind == "U" and math.prod(shape) > _MOST_TEXTS:
        raise InputError(where, f"{math.prod(shape)} texts, expected at most {_MOST_TEXTS}")
    return _Member(info, shape, fortran, dtype)


def _array(where: str, archive: zipfile.ZipFile, member: _Member) -> npt.NDArray[Any]:
    try:
        with archive.open(member.info) as stream:
            _header(stream)
            # flat, and read in pieces, for no copy of all of them
            array = np.empty(math.prod(member.shape), np.dtype("u1") if member.dtype.kind == "b" else member.dtype)
            left = memoryview(array.view(np.uint8).data) if array.nbytes else memoryview(b"")
            while len(left):
                data = stream.read(min(len(left), _PIECE))
                if not data:
                    what = f"{array.nbytes - len(left)} bytes of data, its header says {array.nbytes}"
                    raise InputError(where, what)
                left[: len(data)] = data
                left = left[len(data) :]
            if stream.read(1):  # reaching the end makes zipfile check the sum
                raise InputError(where, f"more data than the {array.nbytes} bytes its header says")
        array = array != 0 if member.dtype.kind == "b" else array.astype(array.dtype.newbyteorder("="), copy=False)
        if array.dtype.kind == "f":
            for start in range(0, len(array), _PIECE):  # in pieces: no mask as large as the array
                if not (np.abs(array[start : start + _PIECE]) <= LARGEST).all():
                    raise InputError(where, f"array holds NaN, infinity or a number over {LARGEST:g}")
        if array.dtype.kind == "U":
            points = array.view(np.uint32)  # numpy makes strings of any number, or fails with SystemError
            if ((points > sys.maxunicode) | ((points >= 0xD800) & (points < 0xE000))).any():
                raise InputError(where, "array holds code points that are no text")
    except _DAMAGE as error:
        raise InputError(where, f"array is damaged ({error})") from error
    return array.reshape(member.shape, order="F" if member.fortran else "C")


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


def check_indices(where: str, indices: npt.NDArray[np.integer], count: int) -> None:
    """Check that every index is in 0..count-1.

    :raises InputError: one is not
    """
    low, high = (int(indices.min()), int(indices.max())) if indices.size else (0, 0)
    if indices.size and (low < 0 or high >= count):
        raise InputError(where, f"index {low if low < 0 else high} out of range, expected 0..{count - 1}")
