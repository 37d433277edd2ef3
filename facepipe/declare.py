"""What an action takes, declared once: its fields with help, range and unit, and their values as JSON.

    width_mm: float = option(3.0, "width of the border", 0.0, 100.0, "mm")

Flags, checks of ranges and recipes follow from that; `facepipe.kinds` has the kinds of actions.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T")
Options = TypeVar("Options", bound="DataclassInstance")

BONE_HELP = (  # of --bone, wherever a face is posed
    "bone coefficient, channels tx ty tz (stage units) rx ry rz (radians) sx sy sz (factor); JOINT is a path, its last "
    "part, or the source's name"
)
POSE_HELP = (  # of --pose, wherever a face is delivered
    "the person that becomes the rest: set (slider values, applied bone coefficients), set-joints (the same in joint "
    "transforms alone: exact, for engines that keep scaled joints), rest (the template), or an animation of the face"
)


def option(
    default: T | Callable[[], T],
    help: str = "",
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
    *,
    choices: tuple[Any, ...] = (),
    parse: Callable[[Any], Any] | None = None,
    flag: str = "",
    metavar: str = "",
    value: JsonValue | None = None,
    kept: bool = True,
    words: bool | int = False,
    alone: str | None = None,
    before: Any = ...,
) -> T:
    """A field of an option dataclass.

    :param default: a callable is called for each
    :param low: numbers lie from `low` to `high`
    :param choices: its values, where they are few and its type is no Literal
    :param parse: its value from a word of the command line; of a tuple or mapping from all its words; with `value` from
        a file
    :param flag: other than ``--name``
    :param value: how JSON holds it, where it is no plain value
    :param kept: in recipes, and so with ``--edit``
    :param alone: its value where the flag is given without one
    :param before: its value in recipes without it, made before there was such an option; ``...``: its default
    :param words: a flag of a tuple or mapping takes all words up to the next flag, or so many, which `metavar` names
    """
    numbers = {"low": low, "high": high, "unit": unit, "choices": choices}
    words_of = {"parse": parse, "flag": flag, "metavar": metavar, "words": words, "alone": alone}
    found: T = _declared(default, {"help": help, **numbers, **words_of, "value": value, "kept": kept, "before": before})
    return found


def source(
    help: str,
    *,
    default: Any = MISSING,
    flag: str = "",
    metavar: str = "",
    split: Callable[[str], tuple[str | None, str]] | None = None,
    kept: bool = True,
    before: Any = ...,
) -> Any:
    """A field of an action for what it is made of: a path, a tuple of paths, or words that can name a file.

    :param flag: it is given as; else it stands alone
    :param kept: in recipes
    :param split: the file that a word names, or None, and what the word says besides
    :param before: as of `option`
    """
    way = {"flag": flag, "metavar": metavar, "split": split, "kept": kept, "parse": tuple if default == () else None}
    return _declared(default, {"help": help, "role": "source", "before": before, **way})


def beside(help: str, suffix: str, write: str, *, holds: str = "", instead: bool = False) -> Any:
    """A field of an action for a file, or folder (no suffix), that is written beside the result where it is asked for.

    :param write: the method that writes it: (face, report, path) -> its entry in the JSON, or None
    :param holds: pattern of the names in the folder, with "/" below it
    :param instead: the command line may ask for it without a result
    """
    named = {"holds": holds, "instead": instead}
    written = {**named, "suffix": suffix, "write": write, "metavar": suffix.removeprefix(".").upper() or "DIR"}
    return _declared(None, {"help": help, "role": "beside", "kept": False, **written})


def _declared(default: Any, said: dict[str, Any]) -> Any:
    way = {} if default is MISSING else {"default_factory": default} if callable(default) else {"default": default}
    return field(**way, metadata=said)


def named_numbers(words: Sequence[str]) -> dict[str, float]:
    """``name=number`` words as a mapping.

    :raises InputError: a word of another form, or a number that is not finite
    """
    numbers = {}
    for word in words:
        name, equals, text = word.rpartition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not equals or not name or not math.isfinite(value):
            raise InputError(word, "expected NAME=NUMBER with a finite number")
        numbers[name] = value
    return numbers


class JsonValue(NamedTuple):
    """How JSON holds a value that is not plain."""

    dump: Callable[[Any], Any]
    load: Callable[[Any, str], Any]  # and the trail, for messages; raises InputError


@dataclass(frozen=True, kw_only=True)
class Field:
    """A field of an option dataclass or an action."""

    name: str
    kinds: tuple[Any, ...]  # types that its values have
    default: Any  # MISSING: it must be given
    help: str = ""
    low: float | None = None
    high: float | None = None
    unit: str = ""
    choices: tuple[Any, ...] = ()
    parse: Callable[[Any], Any] | None = None
    flag: str = ""
    metavar: str = ""
    value: JsonValue | None = None
    kept: bool = True
    words: bool | int = False
    alone: str | None = None
    before: Any = ...
    role: Literal["option", "source", "beside"] = "option"
    split: Callable[[str], tuple[str | None, str]] | None = None
    suffix: str = ""
    write: str = ""
    holds: str = ""
    instead: bool = False

    @property
    def stands_alone(self) -> bool:
        """Whether it is given without a flag."""
        return self.role == "source" and not self.flag

    @property
    def shown(self) -> str:
        """What it is given as: a flag, or the name of what stands alone."""
        if self.stands_alone:
            return self.metavar or self.name.upper()
        return self.flag or f"--{self.name.replace('_', '-')}"

    @property
    def is_read(self) -> bool:
        """Whether the command line gives a file that its value is read from."""
        return self.parse is not None and self.value is not None

    @property
    def needed(self) -> bool:
        """Whether it has no default."""
        return self.default is MISSING

    @property
    def several(self) -> bool:
        """Whether it takes many words."""
        return any(typing.get_origin(kind) in (tuple, Mapping) or kind in (tuple, Mapping) for kind in self.kinds)

    @property
    def listed(self) -> bool:
        """Whether its values are tuples."""
        return all(typing.get_origin(kind) is tuple for kind in self.kinds if kind is not type(None))

    @property
    def word_kind(self) -> type:
        """What a word of the command line is read as: what the items of a tuple are, where nothing else parses them."""
        items = [item for kind in self.kinds for item in typing.get_args(kind)]
        return next((one for one in (Path, float, int) if one in items and (one is Path or self.parse is None)), str)

    def check(self, value: object) -> None:
        """:raises InputError: out of range, not finite, or none of its choices; of a tuple or mapping, one in it"""
        if value is None and self.default is None:
            return
        inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else None
        for one in (value,) if inside is None or not self.several else inside:
            if self.choices and one not in self.choices:
                choices = [str(choice) for choice in self.choices]
                near = did_you_mean(one, choices) if isinstance(one, str) else ""
                expected = f", expected one of {', '.join(choices)}"
                raise InputError(f"option {self.name}", f"is {one!r}{near or expected}")
            if self.low is None or self.high is None or one is None:
                continue
            if not (isinstance(one, int | float) and self.low <= one <= self.high and abs(one) < math.inf):
                expected = f"a number from {self.low:g} to {self.high:g}"
                raise InputError(f"option {self.name}", f"is {one!r}, expected {expected}")

    def load(self, value: object, where: str) -> Any:
        """Its value from what JSON holds.

        :raises InputError: a value of another type
        """
        where = f"{where} -> {self.name}"
        if self.value is not None:
            return self.value.load(value, where)
        return _loaded(value, self.kinds, where)

    def dump(self, value: Any) -> Any:
        """The value as JSON holds it."""
        return json_value(value) if self.value is None else self.value.dump(value)

    @property
    def help_text(self) -> str:
        """Its help, with the unit."""
        return f"{self.help} [{self.unit}]" if self.unit else self.help


@functools.cache
def fields_of(options: Any) -> tuple[Field, ...]:
    """The fields of an option dataclass or an action."""
    hints = typing.get_type_hints(options)
    fields = []
    for one in dataclasses.fields(options):
        kinds, metadata = _flat(hints[one.name]), dict(one.metadata)
        default = one.default if one.default_factory is MISSING else one.default_factory()
        named = (typing.get_args(kind) for kind in kinds if _is_literal(kind))
        metadata["choices"] = metadata.get("choices") or next(named, ())
        fields.append(Field(name=one.name, kinds=kinds, default=default, **metadata))
    return tuple(fields)


def _flat(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(kind for part in typing.get_args(hint) for kind in _flat(part))
    return (hint,)


def values_of(kind: type[DataclassInstance], holder: object) -> dict[str, Any]:
    """Values of the fields of the option dataclass `kind` on `holder`, which has the same fields."""
    return {one.name: getattr(holder, one.name) for one in dataclasses.fields(kind)}


def check_ranges(options: Any) -> None:
    """:raises InputError: an option is out of range, not finite or none of its choices"""
    for one in fields_of(options.__class__):
        one.check(getattr(options, one.name))


@dataclass(frozen=True, kw_only=True)
class Ranged:
    """Base of options that are checked when they are made.

    :raises InputError: an option is out of range, not finite or none of its choices
    """

    def __post_init__(self) -> None:
        check_ranges(self)


def to_json(options: DataclassInstance) -> dict[str, Any]:
    """Field -> its value as JSON holds it."""
    return {one.name: one.dump(getattr(options, one.name)) for one in fields_of(type(options))}


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
    """A dataclass of texts, numbers, booleans, choices and other such dataclasses, from the JSON of its fields; those
    that are left out keep their defaults.

    :raises InputError: no object, an unknown field, one without default left out, or a value of another type or range
    """
    fields = {one.name: one for one in fields_of(kind)}
    if not isinstance(values, Mapping):
        raise InputError(where, f"{_shown(values)}, expected an object of options")
    for name in values:
        if name not in fields:
            near = did_you_mean(str(name), fields) or f", expected some of {', '.join(fields)}"
            raise InputError(where, f"option '{str(name)[:60]}' is unknown{near}")
    given = {name: fields[name].load(value, where) for name, value in values.items()}
    for name, one in fields.items():
        if one.needed and name not in values:
            raise InputError(where, f"no '{name}', expected one")
    try:
        options = kind(**given)
        check_ranges(options)
    except InputError as error:
        raise error.under(where) from None
    return options


def schema_of(kind: type[DataclassInstance]) -> dict[str, Any]:
    """JSON schema (draft 2020-12) of an option dataclass or action: what `Field.dump` gives of its fields.

    Files are strings of the format "path".
    """
    fields, properties = fields_of(kind), {}
    for one in fields:
        limits: dict[str, Any] = {}
        if one.low is not None and one.high is not None:
            limits = {"minimum": one.low, "maximum": one.high}
        if one.choices:
            limits["enum"] = [*one.choices, *([None] if one.default is None else [])]
        kinds = [{} if one.value else _kind_schema(inner, limits) for inner in one.kinds]
        schema = dict(kinds[0]) if len(kinds) == 1 else {} if {} in kinds else {"anyOf": kinds}
        schema |= {"description": one.help_text} if one.help_text else {}
        schema |= {} if one.several else limits
        properties[one.name] = schema if one.needed else {**schema, "default": one.dump(one.default)}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "type": "object",
        "properties": properties,
        "required": [one.name for one in fields if one.needed],
        "additionalProperties": False,
    }


def _kind_schema(kind: Any, limits: dict[str, Any]) -> dict[str, Any]:
    """:param limits: of numbers and texts in lists and objects"""
    arguments = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        return {"type": "array", "items": _kind_schema(arguments[0], limits) | limits}
    if typing.get_origin(kind) is Mapping:
        return {"type": "object", "additionalProperties": _kind_schema(arguments[1], limits) | limits}
    if kind is Path:
        return {"type": "string", "format": "path"}
    name = _JSON_TYPES.get(type(arguments[0]) if _is_literal(kind) else kind)
    return {"type": name} if name else {}


_JSON_TYPES = {type(None): "null", float: "number", int: "integer", str: "string", bool: "boolean"}
_WORDS = {
    type(None): "null",
    Path: "a file",
    float: "a finite number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
}


def _expected(kinds: Sequence[Any]) -> str:
    return " or ".join(", ".join(map(str, typing.get_args(one))) if _is_literal(one) else _words(one) for one in kinds)


def _words(kind: Any) -> str:
    arguments = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return _expected(arguments)
    if typing.get_origin(kind) is tuple:
        count = "" if ... in arguments else f" of {len(arguments)}"
        return f"a list{count} of which each is {_words(arguments[0])}"
    if typing.get_origin(kind) is Mapping:
        return f"an object of which each value is {_words(arguments[1])}"
    return _WORDS.get(kind, "an object" if dataclasses.is_dataclass(kind) else "another value")


def _shown(value: object) -> str:
    try:
        return repr(value)[:40]
    except ValueError:  # an integer of more digits than Python prints
        return "a number beyond reason"


def _is_literal(kind: Any) -> bool:
    return typing.get_origin(kind) is typing.Literal


def _loaded(value: Any, kinds: Sequence[Any], where: str) -> Any:
    """A value as the first of `kinds` that it fits.

    :raises InputError: it fits none; of a list or an object, what in it does not
    """
    kind = next((one for one in kinds if _fits(value, one)), None) or next((k for k in kinds if _holds(value, k)), None)
    if kind is None:
        raise InputError(where, f"{_shown(value)}, expected {_expected(kinds)}")
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return from_json(kind, value, where)
    if typing.get_origin(kind) is tuple:
        items = zip(value, _item_kinds(value, kind), strict=True)
        return tuple(_loaded(item, _flat(one), f"{where} -> {i}") for i, (item, one) in enumerate(items))
    if typing.get_origin(kind) is Mapping:
        inner = _flat(typing.get_args(kind)[1])
        return {key: _loaded(item, inner, f"{where} -> {key[:80]}") for key, item in value.items()}
    return Path(value) if kind is Path else value


def _holds(value: object, kind: Any) -> bool:
    """Whether a list, of the right length, or an object is what `kind` asks for, whatever is in it."""
    if typing.get_origin(kind) is tuple:
        return isinstance(value, list) and len(_item_kinds(value, kind)) == len(value)
    return (typing.get_origin(kind) is Mapping or dataclasses.is_dataclass(kind)) and isinstance(value, Mapping)


def _item_kinds(value: list[Any], kind: Any) -> tuple[Any, ...]:
    arguments = typing.get_args(kind)
    return arguments[:1] * len(value) if ... in arguments else arguments


def _fits(value: Any, kind: Any) -> bool:
    if _is_literal(kind):
        return any(type(value) is type(get_arg) and value == get_arg for get_arg in typing.get_args(kind))
    if isinstance(kind, types.UnionType):
        return any(_fits(value, one) for one in typing.get_args(kind))
    if typing.get_origin(kind) is tuple:
        return _holds(value, kind) and all(map(_fits, value, _item_kinds(value, kind)))
    if typing.get_origin(kind) is Mapping:
        return _holds(value, kind) and all(_fits(one, typing.get_args(kind)[1]) for one in value.values())
    if kind is Path:
        return isinstance(value, str)
    if dataclasses.is_dataclass(kind):
        return isinstance(value, Mapping)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return -1e300 <= value <= 1e300  # NaN and integers beyond any float too
    return type(value) is kind
