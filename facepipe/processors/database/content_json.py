"""The JSON of a face database: who is in it, and how it came to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from facepipe.core.errors import InputError
from facepipe.declare import from_json
from facepipe.processors.database.face_database import REMOVE, Entry, StoredError, Update
from facepipe.processors.database.quality import quality_from

Value = TypeVar("Value")


@dataclass(frozen=True, kw_only=True)
class Header:
    """What the JSON says."""

    meshes: tuple[str, ...]
    shapes: tuple[str, ...]
    shape_meshes: dict[str, tuple[str, ...]]
    left_out: dict[str, tuple[str, ...]]
    entries: tuple[Entry, ...]
    history: tuple[Update, ...]
    tolerance_mm: float


def header_of(content: dict[str, Any], path: Path) -> Header:
    """Read the JSON.

    :raises InputError: a value is missing or of another type, a name is there twice, or versions don't ascend
    """
    found = _Object(content, str(path))
    entries = found.read("entries", lambda value, where: _each(value, where, _entry))
    history = found.read("history", lambda value, where: _each(value, where, _update))
    tolerance = found.read("tolerance_mm", _number)
    header = Header(
        meshes=found.read("meshes", _names),
        shapes=found.read("shapes", _names),
        shape_meshes=found.read("shape_meshes", _name_lists),
        left_out=found.read("left_out", _name_lists),
        entries=entries,
        history=history,
        tolerance_mm=tolerance,
    )
    _check(header, path)
    return header


def _check(header: Header, path: Path) -> None:
    if len(header.entries) < 2 or not header.meshes:
        raise InputError(path, "fewer than two entries or no mesh, expected a face database")
    if len({entry.name for entry in header.entries}) != len(header.entries):
        raise InputError(path, "two entries of one name, expected each once")
    if [update.version for update in header.history] != list(range(1, len(header.history) + 1)):
        raise InputError(f"{path} -> history", "versions that don't count from 1")
    if _names_after(header.history) != [entry.name for entry in header.entries]:
        raise InputError(f"{path} -> history", "other entries than there are")
    if not header.tolerance_mm > 0:
        raise InputError(f"{path} -> tolerance_mm", f"{header.tolerance_mm}, expected a number above 0")


def _names_after(history: tuple[Update, ...]) -> list[str]:
    """Names of the entries that updates leave."""
    names: list[str] = []
    for update in history:
        if update.verb == REMOVE:
            names = [name for name in names if name not in update.entries]
        else:
            names += update.entries
    return names


def _entry(value: Any, where: str) -> Entry:
    found = _Object(value, where)
    return Entry(
        name=found.read("name", _text),
        source=found.read("source", _text),
        digest=found.read("digest", _text),
        content=found.read("content", _text),
        version=found.read("version", _whole),
        stored_error=found.read("stored_error", _or_none(lambda one, there: from_json(StoredError, one, there))),
        quality=found.read("quality", _or_none(quality_from)),
    )


def _update(value: Any, where: str) -> Update:
    found = _Object(value, where)
    return Update(
        version=found.read("version", _whole),
        verb=found.read("verb", _text),
        entries=found.read("entries", _names),
        dropped=found.read("dropped", _names),
        ignored=found.read("ignored", lambda one, there: _each(one, there, _text)),
        facepipe=found.read("facepipe", _text),
    )


class _Object:
    """A JSON object whose members are read by name."""

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise InputError(where, "no object, expected one")
        self._value, self._where = value, where

    def read(self, name: str, reader: Callable[[Any, str], Value]) -> Value:
        if name not in self._value:
            raise InputError(self._where, f"no '{name}', expected one")
        return reader(self._value[name], f"{self._where} -> {name}")


def _each(value: Any, where: str, reader: Callable[[Any, str], Value]) -> tuple[Value, ...]:
    if not isinstance(value, list):
        raise InputError(where, "no list, expected one")
    return tuple(reader(one, f"{where} -> {number}") for number, one in enumerate(value))


def _or_none(reader: Callable[[Any, str], Value]) -> Callable[[Any, str], Value | None]:
    return lambda value, where: None if value is None else reader(value, where)


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(where, f"{str(value)[:40]}, expected a text")
    return value


def _whole(value: Any, where: str) -> int:
    if type(value) is not int or not 0 < value < 1 << 53:
        raise InputError(where, f"{str(value)[:40]}, expected a whole number above 0")
    return value


def _number(value: Any, where: str) -> float:
    if type(value) not in (int, float) or not abs(value) < 1e300:
        raise InputError(where, f"{str(value)[:40]}, expected a finite number")
    return float(value)


def _names(value: Any, where: str) -> tuple[str, ...]:
    found = _each(value, where, _text)
    if len(set(found)) != len(found):
        raise InputError(where, "a name twice, expected each once")
    return found


def _name_lists(value: Any, where: str) -> dict[str, tuple[str, ...]]:
    if not isinstance(value, dict):
        raise InputError(where, "no object, expected one")
    return {name: _names(names, f"{where} -> {name}") for name, names in value.items()}
