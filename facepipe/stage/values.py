"""Between Vt arrays and numpy: the only place that knows both, and whether parts differ in the precision of files.

Exceptions of USD, and of values of other types than their attributes declare, become one-line errors.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from pxr import Gf, Tf, Vt

from facepipe.core.arrays import FloatArray, IntArray, require_finite, require_float32
from facepipe.core.errors import FacepipeError, InputError, TopologyError

Reader = TypeVar("Reader", bound=Callable[..., Any])

USD_ERRORS = (Tf.ErrorException, UnicodeDecodeError)  # names and texts of a damaged file may be no UTF-8
UNREADABLE = (*USD_ERRORS, TypeError, ValueError, OverflowError)  # ... and text where numbers belong


def reason(error: Exception) -> str:
    """The messages of an error without its C++ trail, in one line."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # USD quotes bytes of the file
        return "damaged text"
    messages = re.findall(r" : '(.*?)'\s*(?=\n\s*Error in |\Z)", text, flags=re.DOTALL)
    text = re.sub(r"pxrInternal_\w+::", "", messages[0] if messages else text)
    return " ".join((text or type(error).__name__).split())[:300]


@contextlib.contextmanager
def usd_errors(where: object, *further: type[Exception]) -> Iterator[None]:
    """What USD raises in the block, or another error of the `further` kinds, becomes an InputError at `where`."""
    try:
        yield
    except (*USD_ERRORS, *further) as error:
        raise InputError(where, f"can't be read as USD: {reason(error)}") from None


@contextlib.contextmanager
def errors_below(where: str) -> Iterator[None]:
    """Do as `usd_errors` does; the trails of other errors begin with the file of `where`."""
    file = where.partition(" -> ")[0]
    try:
        with usd_errors(where):
            yield
    except FacepipeError as error:
        raise error if error.where.startswith(file) else error.under(file) from None


def reads_prim(reader: Reader) -> Reader:
    """A reader of a prim whose values may be damaged or of any type: raises InputError at the prim for those."""

    @functools.wraps(reader)
    def guarded(prim: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            return reader(prim, *args, **kwargs)
        except UNREADABLE as error:
            raise InputError(str(prim.GetPath()), f"holds a value that can't be read: {reason(error)}") from None

    return cast(Reader, guarded)


def same(first: object, second: object) -> bool:
    """Whether two parts, or fields of them, are equal in float32; mappings in any order."""
    # in float32, as stages hold them: what was read is the same as what it was made from
    if first is second:
        return True
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        if first is None or second is None:
            return False
        one, other = np.asarray(first), np.asarray(second)
        if one.shape == other.shape and "f" in one.dtype.kind + other.dtype.kind:
            one, other = one.astype(np.float32), other.astype(np.float32)
        return np.array_equal(one, other)
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, tuple | list) and isinstance(second, tuple | list):
        return len(first) == len(second) and all(map(same, first, second))
    if dataclasses.is_dataclass(first) and type(first) is type(second):
        return all(same(getattr(first, field.name), getattr(second, field.name)) for field in dataclasses.fields(first))
    if isinstance(first, float) and isinstance(second, float):
        return bool(np.float32(first) == np.float32(second))
    return first == second


def require_same(where: object, old: object, new: object, fields: Iterable[str]) -> None:
    """:raises InputError: one of the fields differs"""
    for field in fields:
        if not same(getattr(old, field), getattr(new, field)):
            raise InputError(f"{where} -> {field}", "differs, expected as on the face")


# Fields of parts that a stage holds in float64, or as JSON text.
_DOUBLES = (
    *("transform", "geom_bind_transform", "bind_transforms", "rest_transforms", "times"),
    *("meters_per_unit", "frames_per_second", "options", "info", "vrm"),
)


def require_writable(parts: object, where: str) -> None:
    """:raises InputError: NaN, infinity, or what a stage would hold as infinity, with the trail there"""
    require_finite(parts, where)
    require_float32(parts, where, doubles=_DOUBLES)


def floats(value: Any, width: int | None = None) -> npt.NDArray[np.float32]:
    """A Vt array of floats or vectors as (n,) or (n, width) float32; None gives an empty array."""
    array = np.array(value if value is not None else [], dtype=np.float32)
    return array.reshape(-1, width) if width else array.reshape(-1)


def check_inside(where: object, name: str, indices: IntArray, count: int) -> None:
    """:raises TopologyError: indices, called `name`, of which some are not 0..count - 1"""
    if indices.size and not (indices.min() >= 0 and indices.max() < count):
        raise TopologyError(where, f"{name} outside 0..{count - 1}")


def ints(value: Any) -> npt.NDArray[np.int32]:
    """A Vt int array as (n,) int32; None gives an empty array."""
    return np.array(value if value is not None else [], dtype=np.int32).reshape(-1)


def matrix(value: Gf.Matrix4d) -> FloatArray:
    """A Gf matrix (row vectors) as a (4, 4) float64 one in column vectors."""
    return np.array(value, dtype=np.float64).T


def matrices(value: Any) -> FloatArray:
    """A Vt array of Gf matrices as (n, 4, 4) float64 in column vectors."""
    array = np.array(value if value is not None else [], dtype=np.float64).reshape(-1, 4, 4)
    return np.ascontiguousarray(array.transpose(0, 2, 1))


def quaternions(value: Any) -> npt.NDArray[np.float32]:
    """A Vt array of quaternions as (n, 4) float32, x y z w (as USD stores them in memory)."""
    return np.array(value if value is not None else [], dtype=np.float32).reshape(-1, 4)


def to_matrix(value: FloatArray) -> Gf.Matrix4d:
    """A (4, 4) column-vector matrix as a Gf one."""
    return Gf.Matrix4d(np.ascontiguousarray(np.asarray(value, dtype=np.float64).T))


def to_matrices(value: FloatArray) -> Vt.Matrix4dArray:
    """(n, 4, 4) column-vector matrices as a Vt array."""
    return Vt.Matrix4dArray.FromNumpy(_ready(np.asarray(value).transpose(0, 2, 1), np.float64))


def to_vec3f(value: FloatArray) -> Vt.Vec3fArray:
    """(n, 3) as a Vt array."""
    return Vt.Vec3fArray.FromNumpy(_ready(value, np.float32).reshape(-1, 3))


def to_vec3h(value: FloatArray) -> Vt.Vec3hArray:
    """(n, 3) as a Vt array of half precision."""
    return Vt.Vec3hArray([Gf.Vec3h(*(float(x) for x in row)) for row in np.asarray(value).reshape(-1, 3)])


def to_vec2f(value: FloatArray) -> Vt.Vec2fArray:
    """(n, 2) as a Vt array."""
    return Vt.Vec2fArray.FromNumpy(_ready(value, np.float32).reshape(-1, 2))


def to_quatf(value: FloatArray) -> Vt.QuatfArray:
    """(n, 4) quaternions x y z w as a Vt array."""
    rows = np.asarray(value, dtype=np.float64).reshape(-1, 4)
    return Vt.QuatfArray([Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in rows])


def to_floats(value: FloatArray) -> Vt.FloatArray:
    """(n,) as a Vt array."""
    return Vt.FloatArray.FromNumpy(_ready(value, np.float32).reshape(-1))


def to_ints(value: IntArray) -> Vt.IntArray:
    """(n,) as a Vt array."""
    return Vt.IntArray.FromNumpy(_ready(value, np.int32).reshape(-1))


def _ready(value: Any, dtype: Any) -> Any:
    return np.ascontiguousarray(value, dtype=dtype)
