"""glTF accessors as numpy arrays: strides, sparse data, normalised integers.

Every range is checked before data is touched.

Source: glTF 2.0 section 3.6 (binary data storage) and KHR_mesh_quantization.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe_gltf.read.document import Document, Value, quote

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_COUNT = 2**31

RawArray = npt.NDArray[np.generic]


@dataclass(frozen=True)
class Accessor:
    """A checked accessor: its raw base values (count, components), None for zeros, and its sparse replacements."""

    value: Value
    count: int
    components: int
    dtype: np.dtype[np.generic]
    normalized: bool
    base: RawArray | None
    sparse: tuple[IntArray, RawArray] | None


@dataclass(frozen=True)
class Deltas:
    """The rows of an array that are not all zero."""

    indices: IntArray  # (k,) ascending
    values: FloatArray  # (k, 3)


def accessor(document: Document, reference: Value, *types: str) -> Accessor:
    """The accessor that `reference` names, of one of `types` (``VEC3`` ...), of any where none is given.

    :raises InputError: another type, or data outside its bufferView
    """
    value = document.entry("accessors", reference)
    dtype, components = element(value)
    if types and (kind := value.members()["type"]) not in types:
        raise reference.error(f"{value.place} is {kind}, expected {' or '.join(types)}")
    count = value.require("count").integer(1)
    # an accessor without bufferView is zeros: its count asks for memory that no byte of the file stands for
    if count > _MAX_COUNT:
        raise value.error(f"count {count}, expected at most {_MAX_COUNT}")
    base, view = None, value.get("bufferView")
    if view is not None:
        stride = document.entry("bufferViews", view).get("byteStride")
        size = components * dtype.itemsize
        step = size if stride is None else stride.integer(1)
        if stride is not None and step < size:
            raise stride.error(f"{step} bytes, expected at least the element's {size}")
        base = _strided(document, value, view, count, components, dtype, step)
    normalized = value.get_or("normalized", False).flag()
    sparse, replaced = value.get("sparse"), None
    if sparse is not None:
        entries = sparse.require("count").integer(1)
        if entries > count:
            raise sparse.error(f"{entries} entries of {count} elements")
        document.budget.spend(8 * entries, sparse.error)
        at = sparse.require("indices")
        index_dtype = _dtype(at.require("componentType"))
        if index_dtype.kind != "u":
            raise at.error("signed or float indices, expected unsigned integers")
        indices = _packed(document, at, entries, 1, index_dtype)[:, 0].astype(np.int64)
        if indices[-1] >= count or indices.max() >= count:
            raise at.error(f"index {int(indices.max())} of {count} elements")
        # glTF asks for it: an index twice would give an element two values
        if np.any(np.diff(indices) <= 0):
            raise at.error("indices are not strictly ascending")
        replaced = indices, _packed(document, sparse.require("values"), entries, components, dtype)
    return Accessor(
        value=value,
        count=count,
        components=components,
        dtype=dtype,
        normalized=normalized,
        base=base,
        sparse=replaced,
    )


def element(value: Value) -> tuple[np.dtype[np.generic], int]:
    """The type of the components of an accessor's elements, and how many each has.

    :raises InputError: types that glTF doesn't have
    """
    kind = value.require("type")
    if kind.text() not in _COMPONENTS:
        raise kind.error(f"{quote(kind.text())}, expected {' or '.join(_COMPONENTS)}")
    return _dtype(value.require("componentType")), _COMPONENTS[kind.text()]


def floats(document: Document, reference: Value, *types: str, count: int | None = None) -> FloatArray:
    """(count, components) float32, integers normalised where the accessor says so.

    :raises InputError: not `count` elements, non-finite values, or what `accessor` raises
    """
    checked = accessor(document, reference, *types)
    _expect_count(checked, reference, count)
    document.budget.spend(checked.count * checked.components * 8, checked.value.error)
    if checked.base is None:
        result = np.zeros((checked.count, checked.components), np.float32)
    else:
        result = _to_floats(checked, checked.base)
    if checked.sparse is not None:
        result[checked.sparse[0]] = _to_floats(checked, checked.sparse[1])
    return result


def numbers(document: Document, checked: Accessor) -> FloatArray:
    """(count, components) float64, integers normalised where the accessor says so, NaN and infinity as they are.

    :raises InputError: far more numbers than the file holds
    """
    document.budget.check(checked.count * checked.components * 8, checked.value.error)
    return _fractions(checked, _stored(checked).astype(np.float64))


def integers(document: Document, reference: Value, kind: str, *, count: int | None = None) -> IntArray:
    """(count, components) of an unsigned integer accessor.

    :raises InputError: signed or float components, not `count` elements, or what `accessor` raises
    """
    checked = accessor(document, reference, kind)
    _expect_count(checked, reference, count)
    if checked.dtype.kind != "u":
        raise checked.value.error("signed or float components, expected unsigned integers")
    document.budget.spend(checked.count * checked.components * 8, checked.value.error)
    return _stored(checked)


def _stored(checked: Accessor) -> npt.NDArray[Any]:
    """(count, components) values as they are stored, a copy."""
    shape = (checked.count, checked.components)
    result: npt.NDArray[Any] = np.zeros(shape, checked.dtype) if checked.base is None else np.array(checked.base)
    if checked.sparse is not None:
        result[checked.sparse[0]] = checked.sparse[1]
    return result


def deltas(document: Document, reference: Value, count: int) -> Deltas:
    """The non-zero rows of a VEC3 accessor of `count` elements; zeros behind sparse data are never allocated."""
    checked = accessor(document, reference, "VEC3")
    _expect_count(checked, reference, count)
    if checked.base is None and checked.sparse is None:
        return Deltas(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
    if checked.base is None and checked.sparse is not None:
        indices, values = checked.sparse[0], _to_floats(checked, checked.sparse[1])
    else:
        values = floats(document, reference, "VEC3")
        indices = np.arange(count)
    moved = np.any(values != 0.0, axis=1)
    document.budget.spend(16 * int(np.count_nonzero(moved)), checked.value.error)
    return Deltas(np.asarray(indices)[moved].astype(np.int64), values[moved])


def _expect_count(checked: Accessor, reference: Value, count: int | None) -> None:
    if count is not None and checked.count != count:
        raise reference.error(f"{checked.value.place} has {checked.count} elements, expected {count}")


def _dtype(value: Value) -> np.dtype[np.generic]:
    number = value.integer()
    if number not in _DTYPES:
        raise value.error(f"{number}, expected one of {', '.join(map(str, _DTYPES))}")
    return np.dtype(_DTYPES[number])


def _strided(
    document: Document,
    value: Value,
    reference: Value,
    count: int,
    components: int,
    dtype: np.dtype[np.generic],
    step: int,
) -> RawArray:
    data, start, length = document.view(reference)
    offset = value.get_or("byteOffset", 0).integer()
    end = offset + step * (count - 1) + components * dtype.itemsize
    if end > length:
        raise value.error(f"{count} elements end at byte {end} of a bufferView of {length}")
    return np.ndarray((count, components), dtype, data, start + offset, (step, dtype.itemsize))


def _packed(document: Document, value: Value, count: int, components: int, dtype: np.dtype[np.generic]) -> RawArray:
    reference = value.require("bufferView")
    return _strided(document, value, reference, count, components, dtype, components * dtype.itemsize)


def _to_floats(checked: Accessor, raw: RawArray) -> FloatArray:
    values = raw.astype(np.float32)
    if checked.dtype.kind == "f" and not np.isfinite(values).all():
        raise checked.value.error(f"non-finite value at element {int(np.argmin(np.isfinite(values).all(axis=1)))}")
    return _fractions(checked, values)


def _fractions(checked: Accessor, values: FloatArray) -> FloatArray:
    """Integers as the fractions they stand for where they are normalised (section 3.11), in place."""
    if checked.normalized and checked.dtype.kind != "f":
        values /= values.dtype.type(np.iinfo(checked.dtype).max)  # type: ignore[type-var]
        np.maximum(values, -1.0, out=values)
    return values
