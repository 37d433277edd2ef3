"""Whether parts differ, in the precision that files hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError

AnyArray = npt.NDArray[Any]


def same(first: object, second: object) -> bool:
    """Whether two parts, or fields of them, are equal in float32; mappings in any order."""
    if first is second:
        return True
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        return first is not None and second is not None and _same_arrays(np.asarray(first), np.asarray(second))
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


def _same_arrays(first: AnyArray, second: AnyArray) -> bool:
    if first.shape != second.shape:
        return False
    if "f" in first.dtype.kind + second.dtype.kind:
        return np.array_equal(first.astype(np.float32), second.astype(np.float32))
    return np.array_equal(first, second)
