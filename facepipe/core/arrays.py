"""Types of arrays, whose shapes docstrings give, and the search for NaN and infinity in values of any kind."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import FacepipeError, InputError

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]
AnyArray = npt.NDArray[Any]


def require_finite(value: object, *where: str, error: type[FacepipeError] = InputError) -> None:
    """Walk dataclasses, mappings, sequences, arrays and numbers.

    :param where: the trail to `value`, for the message
    :raises error: the first NaN or infinity, with the names and fields on the way to it
    """
    if _finite(value):  # quick: only where it is not, the way there is looked for
        return
    for trail in _culprits(value):
        raise error(" -> ".join([*where, *trail]) or "value", "NaN or infinity, expected finite numbers")


def _finite(value: Any) -> bool:
    if isinstance(value, float | np.floating):
        return math.isfinite(value)
    if isinstance(value, str | bytes | int | None):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "fc" or bool(np.isfinite(value).all())
    if isinstance(value, tuple | list):
        return all(map(_finite, value))
    if isinstance(value, Mapping):
        return all(map(_finite, value.values()))
    return all(_finite(getattr(value, name)) for name in _field_names(value.__class__))


@functools.cache
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else ()


def _culprits(value: object) -> Iterator[tuple[str, ...]]:
    if isinstance(value, str | bytes | int | None):
        return
    if isinstance(value, float | np.floating):
        if not math.isfinite(value):
            yield ()
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "fc" and not np.isfinite(value).all():
            yield ()
    else:
        inside: list[tuple[str, object]] = []
        if dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                inner = getattr(value, field.name)
                named = isinstance(inner, tuple) and inner and _name(inner[0])
                inside.append(("" if named else field.name, inner))  # of a named tuple the name, not the number
        elif isinstance(value, Mapping):
            inside += [(str(key), inner) for key, inner in value.items()]
        elif isinstance(value, tuple | list):
            inside += [(_name(inner), inner) for inner in value]
        for label, inner in inside:
            for trail in _culprits(inner):
                yield (label, *trail) if label else trail


def _name(value: object) -> str:
    return str(getattr(value, "name", "")) if dataclasses.is_dataclass(value) else ""
