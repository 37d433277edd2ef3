"""Option dataclasses: their ranges, and their values as JSON."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from facepipe.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")

POSE_HELP = (
    "the person that becomes the rest: set (slider values, applied bone coefficients), set-joints (the same in joint "
    "transforms alone: exact, for engines that keep scaled joints), rest (the template), or an animation of the face"
)


def check_ranges(options: DataclassInstance) -> None:
    """Check `options` against their fields' ``metadata``: "range", a pair (lowest, highest), and "choices".

    :raises InputError: an option is out of range, not finite or none of its choices
    """
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if value is None and field.default is None:
            continue
        if "choices" in field.metadata and value not in field.metadata["choices"]:
            expected = ", ".join(map(str, field.metadata["choices"]))
            raise InputError(f"option {field.name}", f"is {value!r}, expected one of {expected}")
        if "range" not in field.metadata or value is None:
            continue
        low, high = field.metadata["range"]
        if not (isinstance(value, int | float) and low <= value <= high and abs(value) < math.inf):
            raise InputError(f"option {field.name}", f"is {value!r}, expected a number from {low:g} to {high:g}")


def to_json(options: DataclassInstance) -> dict[str, Any]:
    """Field -> its value as JSON holds it."""
    return {field.name: json_value(getattr(options, field.name)) for field in dataclasses.fields(options)}


def json_value(value: object) -> Any:
    """`value` as JSON holds it: paths become strings, tuples lists, mappings dictionaries with sorted keys."""
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, Mapping):
        return {str(key): json_value(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    return value


def from_json(kind: type[Options], values: object, where: str) -> Options:
    """Options of texts, numbers, booleans and choices from what `to_json` gave; fields left out keep their defaults.

    :raises InputError: no object, an unknown field, one without default left out, or a value of another type or range
    """
    hints = typing.get_type_hints(kind)
    if not isinstance(values, Mapping):
        raise InputError(where, f"{str(values)[:40]}, expected an object of options")
    for name, value in values.items():
        if name not in hints:
            raise InputError(where, f"option '{str(name)[:60]}' is unknown, expected some of {', '.join(hints)}")
        if not _fits(value, hints[name]):
            raise InputError(f"{where} -> {name}", f"{repr(value)[:40]}, expected {_expected(hints[name])}")
    for field in dataclasses.fields(kind):
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in values:
            raise InputError(where, f"no '{field.name}', expected one")
    try:
        options = kind(**values)
        check_ranges(options)
    except InputError as error:
        raise error.under(where) from None
    return options


def _kinds(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def _fits(value: object, hint: Any) -> bool:
    for kind in _kinds(hint):
        if typing.get_origin(kind) is typing.Literal:
            if isinstance(value, str) and value in typing.get_args(kind):
                return True
        elif kind is float and type(value) in (int, float):
            return -1e300 <= typing.cast(float, value) <= 1e300  # NaN and integers beyond any float too
        elif type(value) is kind:
            return True
    return False


def _expected(hint: Any) -> str:
    words = {type(None): "null", float: "a finite number", int: "a whole number", str: "a text", bool: "true or false"}
    return " or ".join(
        ", ".join(map(str, typing.get_args(kind)))
        if typing.get_origin(kind) is typing.Literal
        else words.get(kind, "another value")
        for kind in _kinds(hint)
    )
