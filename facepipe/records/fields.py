"""Parts as JSON and back, by the types of their fields: arrays beside, fields at their default left out."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

from facepipe.core.errors import InputError
from facepipe.records.arrays import ArrayReader, ArrayWriter

Part = TypeVar("Part")


def to_json(value: object, arrays: ArrayWriter) -> Any:
    """Dataclasses, mappings, sequences, arrays, text and numbers as JSON; bytes as hexadecimal text."""
    if isinstance(value, np.ndarray):
        return arrays.reference(value)
    if dataclasses.is_dataclass(value):
        fields = [(one, getattr(value, one.name)) for one in dataclasses.fields(value)]
        return {one.name: to_json(inner, arrays) for one, inner in fields if not _is_default(one, inner)}
    if isinstance(value, Mapping):
        return {str(key): to_json(inner, arrays) for key, inner in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(inner, arrays) for inner in value]
    if isinstance(value, bytes):
        return value.hex()
    return value.item() if isinstance(value, np.generic) else value


def _is_default(field: dataclasses.Field[Any], value: object) -> bool:
    default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    if isinstance(value, np.ndarray) and isinstance(default, np.ndarray):
        return np.array_equal(value, default)
    return type(value) is type(default) and not dataclasses.is_dataclass(value) and bool(value == default)


def from_json(kind: type[Part], data: object, arrays: ArrayReader, where: str) -> Part:
    """The `kind` of part that `to_json` wrote.

    :raises InputError: a field that `kind` has not, lacks or can't have
    """
    result: Part = _read(kind, data, arrays, where)
    return result


def _read(kind: Any, data: Any, arrays: ArrayReader, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _dataclass(kind, data, arrays, where)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return arrays.array(data, where)
    if origin in (Union, types.UnionType):
        return _union(arguments, data, arrays, where)
    if origin is tuple and isinstance(data, list):
        kinds = arguments[:1] * len(data) if arguments[-1] is ... else arguments
        if len(kinds) == len(data):
            pairs = enumerate(zip(kinds, data, strict=True))
            return tuple(_read(one, item, arrays, f"{where}[{i}]") for i, (one, item) in pairs)
    elif origin is not None and origin is not Literal and issubclass(origin, Mapping) and isinstance(data, dict):
        return {key: _read(arguments[1], item, arrays, f"{where}.{key}"[:200]) for key, item in data.items()}
    elif kind is bytes and isinstance(data, str) and not set(data) - set("0123456789abcdef") and len(data) % 2 == 0:
        return bytes.fromhex(data)
    elif _is_plain(kind, origin, arguments, data):
        return float(data) if kind is float else data
    raise InputError(where, "a value of the wrong kind")


def _is_plain(kind: Any, origin: Any, arguments: tuple[Any, ...], data: object) -> bool:
    if origin is Literal:
        return isinstance(data, str) and data in arguments
    if kind is object:
        return True
    if kind is float:
        return isinstance(data, int | float) and not isinstance(data, bool) and math.isfinite(data)
    if kind is int:
        return isinstance(data, int) and not isinstance(data, bool)
    if kind is str:
        return isinstance(data, str) and not any("\ud800" <= one <= "\udfff" for one in data)
    return kind in (bool, type(None)) and isinstance(data, kind)


def _union(kinds: tuple[Any, ...], data: object, arrays: ArrayReader, where: str) -> Any:
    """The first kind that fits; of several none reads what another is meant to."""
    problem = InputError(where, "a value of the wrong kind")
    for kind in kinds:
        try:
            return _read(kind, data, arrays, where)
        except InputError as error:
            problem = error
    raise problem


def _dataclass(kind: Any, data: object, arrays: ArrayReader, where: str) -> Any:
    if not isinstance(data, dict):
        raise InputError(where, "no object, expected one")
    hints = _hints(kind)
    unknown = sorted(set(data) - set(hints))
    if unknown:
        raise InputError(where, f"has '{ascii(unknown[0])[1:40]}', which this version does not know")
    values = {name: _read(hints[name], inner, arrays, f"{where}.{name}") for name, inner in data.items()}
    try:
        return kind(**values)
    except TypeError:
        raise InputError(where, "lacks a value") from None


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)
