"""Types of arrays, whose shapes docstrings give, and the search for NaN and infinity in values of any kind."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
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

_LARGEST = float(np.finfo(np.float32).max)
_NUMBERS, _WORDS = (float, np.floating, np.ndarray), (str, bytes, int, type(None))


def require_finite(value: object, *where: str, error: type[FacepipeError] = InputError) -> None:
    """Walk dataclasses, mappings, sequences, arrays and numbers.

    :param where: the trail to `value`, for the message
    :raises error: the first NaN or infinity, with the names and fields on the way to it
    """
    _require(_is_finite, (), value, where, error("", "NaN or infinity, expected finite numbers"))


def require_float32(
    value: object, *where: str, doubles: Collection[str] = (), error: type[FacepipeError] = InputError
) -> None:
    """The same walk for numbers that float32 makes infinity of, where files hold no more than that.

    :param doubles: fields that are not walked, as files hold them in float64 or as text
    :raises error: the first number beyond float32, NaN or infinity
    """
    _require(_is_float32, doubles, value, where, error("", "NaN, infinity or beyond float32, expected finite numbers"))


def _require(
    sound: Callable[[Any], bool], skipped: Collection[str], value: object, where: tuple[str, ...], error: FacepipeError
) -> None:
    if _all_sound(sound, skipped, value):  # quick: only where it is not, the way there is looked for
        return
    for trail in _culprits(sound, skipped, value):
        raise type(error)(" -> ".join([*where, *trail]) or "value", error.what)


def _is_finite(number: Any) -> bool:
    if isinstance(number, np.ndarray):
        return number.dtype.kind not in "fc" or bool(np.isfinite(number).all())
    return math.isfinite(number)


def _is_float32(number: Any) -> bool:
    if isinstance(number, np.ndarray) and number.dtype.kind == "f" and number.dtype.itemsize > 4:
        return not number.size or bool(number.min() >= -_LARGEST and number.max() <= _LARGEST)
    return _is_finite(number) if isinstance(number, np.ndarray) else bool(abs(number) <= _LARGEST)


def _all_sound(sound: Callable[[Any], bool], skipped: Collection[str], value: Any) -> bool:
    if isinstance(value, _NUMBERS):
        return sound(value)
    if isinstance(value, _WORDS):
        return True
    if isinstance(value, tuple | list):
        return all(_all_sound(sound, skipped, one) for one in value)
    if isinstance(value, Mapping):
        return all(_all_sound(sound, skipped, one) for one in value.values())
    fields = _field_names(value.__class__)
    return all(name in skipped or _all_sound(sound, skipped, getattr(value, name)) for name in fields)


@functools.cache
def _field_names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else ()


def _culprits(sound: Callable[[Any], bool], skipped: Collection[str], value: object) -> Iterator[tuple[str, ...]]:
    if isinstance(value, _WORDS):
        return
    if isinstance(value, _NUMBERS):
        if not sound(value):
            yield ()
    else:
        inside: list[tuple[str, object]] = []
        if dataclasses.is_dataclass(value):
            for field in (one for one in dataclasses.fields(value) if one.name not in skipped):
                inner = getattr(value, field.name)
                named = isinstance(inner, tuple) and inner and _name(inner[0])
                inside.append(("" if named else field.name, inner))  # of a named tuple the name, not the number
        elif isinstance(value, Mapping):
            inside += [(str(key), inner) for key, inner in value.items()]
        elif isinstance(value, tuple | list):
            inside += [(_name(inner), inner) for inner in value]
        for label, inner in inside:
            for trail in _culprits(sound, skipped, inner):
                yield (label, *trail) if label else trail


def _name(value: object) -> str:
    return str(getattr(value, "name", "")) if dataclasses.is_dataclass(value) else ""
