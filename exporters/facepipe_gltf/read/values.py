"""JSON of a glTF file as values that know their place, so that every error names its trail."""

from __future__ import annotations

import json
import unicodedata
from collections import Counter
from dataclasses import dataclass
from typing import Any, NoReturn

from facepipe.core import names
from facepipe.core.errors import InputError
from facepipe.core.reading import check_values

LARGEST = 1e18  # number that is believed: products of two still fit in float32, which files and engines hold
_LONGEST = 80  # characters of a name that is made of another

_TYPE_NAMES = {dict: "an object", list: "an array", str: "text", bool: "true or false", type(None): "null"}


@dataclass(frozen=True)
class Value:
    """One JSON value and the trail to it, like ``head.glb -> accessors[3].count``.

    The readers below raise `InputError` when the value is not of the kind asked for; booleans are no numbers.
    """

    data: object
    trail: str
    root: bool = False

    @property
    def place(self) -> str:
        """The trail inside the document, for naming one place in an error about another."""
        return self.trail.partition(" -> ")[2]

    def error(self, what: str) -> InputError:
        """An error at this place."""
        return InputError(self.trail, what)

    def get(self, key: str) -> Value | None:
        """The member `key` of an object, None where there is none."""
        members = self.members()
        if key not in members:
            return None
        return Value(members[key], f"{self.trail}{' -> ' if self.root else '.'}{key}")

    def get_or(self, key: str, default: object) -> Value:
        """The member `key` of an object, `default` in its place where there is none."""
        return self.get(key) or Value(default, self.trail)

    def extension(self, name: str) -> Value | None:
        """What an extension says of an object, None where it says nothing."""
        return self.get_or("extensions", {}).get(name)

    def extras(self) -> Value:
        """The extras of an object; empty where there are none, or where they are no object."""
        extras = self.get_or("extras", {})
        return extras if isinstance(extras.data, dict) else Value({}, extras.trail)

    def require(self, key: str) -> Value:
        """The member `key` of an object that must have it."""
        value = self.get(key)
        if value is None:
            raise self.error(f"no {key}, expected one")
        return value

    def member_names(self) -> list[str]:
        """The names of an object's members, in file order."""
        return list(self.members())

    def items(self) -> list[Value]:
        """The elements of an array."""
        if not isinstance(self.data, list):
            raise self._expected("an array")
        return [Value(item, f"{self.trail}[{i}]") for i, item in enumerate(self.data)]

    def integer(self, low: int = 0) -> int:
        """A whole number of at least `low`; 3.0 counts as 3, as JSON makes no difference."""
        data = self.data
        if isinstance(data, float) and data.is_integer():
            data = int(data)
        if isinstance(data, bool) or not isinstance(data, int):
            raise self._expected("a whole number")
        if not low <= data < 2**53:
            raise self.error(f"{_short(data)}, expected a whole number from {low} to 2^53")
        return data

    def number(self) -> float:
        """A number of at most `LARGEST`, either sign."""
        if isinstance(self.data, bool) or not isinstance(self.data, int | float):
            raise self._expected("a number")
        if not abs(self.data) <= LARGEST:
            raise self.error(f"{_short(self.data)}, expected a number from {-LARGEST:g} to {LARGEST:g}")
        return float(self.data)

    def numbers(self, count: int | None = None) -> tuple[float, ...]:
        """An array of `count` numbers."""
        items = self.items()
        if count is not None and len(items) != count:
            raise self.error(f"{len(items)} numbers, expected {count}")
        return tuple(item.number() for item in items)

    def text(self) -> str:
        """Text that UTF-8 can hold."""
        if not isinstance(self.data, str):
            raise self._expected("text")
        if any("\ud800" <= character <= "\udfff" for character in self.data):
            raise self.error("text with half a surrogate pair, expected Unicode")
        return self.data

    def name(self) -> str:
        """Text that can be a name: USD ends names at a NUL."""
        if "\0" in self.text():
            raise self.error("a name with a NUL character, expected none")
        return self.text()

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self.data, bool):
            raise self._expected("true or false")
        return self.data

    def members(self) -> dict[str, Any]:
        """The members of an object, as JSON has them."""
        if not isinstance(self.data, dict):
            raise self._expected("an object")
        return self.data

    def _expected(self, kind: str) -> InputError:
        shown = _TYPE_NAMES.get(type(self.data)) or _short(self.data)
        if isinstance(self.data, str):
            shown = f"the text {quote(self.data)}"
        return self.error(f"is {shown}, expected {kind}")


def quote(text: str) -> str:
    """`text` in quotes, escaped and short enough for a one-line message."""
    return ascii(text if len(text) <= 60 else f"{text[:57]}...")


def parse(text: bytes, trail: str) -> Value:
    """The JSON object in `text`.

    :raises InputError: not UTF-8, not JSON (NaN and Infinity are no JSON), nested too deeply, or not an object
    """
    check_values(trail, text)
    try:
        data = json.loads(text.decode("utf-8-sig"), parse_constant=_refuse)
    except RecursionError:
        raise InputError(trail, "JSON nested too deeply") from None
    except UnicodeDecodeError as error:
        raise InputError(trail, f"JSON isn't UTF-8: {error.reason} at byte {error.start}") from None
    except ValueError as error:
        raise InputError(trail, f"not JSON: {ascii(str(error))[1:-1][:100]}") from None
    value = Value(data, trail, root=True)
    if not isinstance(data, dict):
        raise value.error("its JSON is not an object, expected a glTF object")
    return value


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")


def _short(data: object) -> str:
    if isinstance(data, int) and abs(data) >= 10**20:
        return "a number beyond 10^20"  # not printed: Python limits how many digits it converts
    return str(data)[:40]


def given_name(value: Value) -> str | None:
    """The name that an object of the document has, exactly; None where it has none."""
    name = value.get("name")
    return None if name is None else name.name()


def file_name(name: str, fallback: str) -> str:
    """`name` as letters of ASCII, digits and underscores, for files.

    Accents are dropped, other characters beyond ASCII become ``u`` and their hexadecimal code, so that names in
    other scripts stay apart; the rest becomes ``_``. An empty name is `fallback`.
    """
    plain = unicodedata.normalize("NFKD", name[: 4 * _LONGEST])
    safe = "".join(
        (character if character.isascii() else f"u{ord(character):x}_")
        for character in plain
        if not unicodedata.combining(character)
    )[:_LONGEST]
    return names.identifier(safe, fallback)


class Names:
    """Hands out names, each once: one that is taken gets ``_2``, ``_3`` ... behind it."""

    def __init__(self) -> None:
        self._taken: set[str] = set()
        self._next: Counter[str] = Counter()
        self._known: dict[tuple[str, int], str] = {}

    def new(self, base: str) -> str:
        """`base`, or the first numbered name after it that is free."""
        result = base
        while result in self._taken:
            self._next[base] += 1
            result = f"{base}_{self._next[base] + 1}"
        self._taken.add(result)
        return result

    def same(self, name: str, occurrence: int) -> str:
        """The name of the n-th thing called `name`: always the same one for the same two."""
        key = (name, occurrence)
        if key not in self._known:
            self._known[key] = self.new(name)
        return self._known[key]


def joint_identifier(name: str) -> str:
    """The part of a joint's path that stands for `name`."""
    return names.identifier(name[:_LONGEST], "joint")
