"""Whether parts differ, in the precision that files hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]


def same(one: object, other: object) -> bool:
    """Whether two parts, or fields of them, are equal in float32; mappings in any order."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return one is not None and other is not None and _same_arrays(np.asarray(one), np.asarray(other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        return all(same(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one))
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.float32(one) == np.float32(other))
    return one == other


def _same_arrays(one: AnyArray, other: AnyArray) -> bool:
    if one.shape != other.shape:
        return False
    if "f" in one.dtype.kind + other.dtype.kind:
        return np.array_equal(one.astype(np.float32), other.astype(np.float32))
    return np.array_equal(one, other)
