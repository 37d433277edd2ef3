"""Types of arrays, whose shapes docstrings give, and the search for NaN and infinity in values of any kind."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import FacepipeError, InputError

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
BoolArray = npt.NDArray[np.bool_]


def require_finite(value: object, *where: str, error: type[FacepipeError] = InputError) -> None:
    """Walk dataclasses, mappings, sequences, arrays and numbers.

    :param where: the trail to `value`, for the message
    :raises error: the first NaN or infinity, with the names and fields on the way to it
    """
    for trail in _culprits(value):
        raise error(" -> ".join([*where, *trail]) or "value", "NaN or infinity, expected finite numbers")


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
        for label, inner in _children(value):
            for trail in _culprits(inner):
                yield (label, *trail) if label else trail


def _children(value: object) -> Iterator[tuple[str, object]]:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            inner = getattr(value, field.name)
            # of a named tuple: the name, not the number
            named = isinstance(inner, tuple) and inner and _name(inner[0])
            yield ("" if named else field.name), inner
    elif isinstance(value, Mapping):
        yield from ((str(key), inner) for key, inner in value.items())
    elif isinstance(value, tuple | list):
        yield from ((_name(inner), inner) for inner in value)


def _name(value: object) -> str:
    return str(getattr(value, "name", "")) if dataclasses.is_dataclass(value) else ""
