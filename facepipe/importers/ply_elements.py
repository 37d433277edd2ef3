"""The elements of a PLY file as arrays: text, binary of both byte orders, scalar and list properties.

Nothing is allocated for a count of the header before the data has shown that it holds that many.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError

Columns = npt.NDArray[Any]  # (n,) values of a scalar property

_NAMES = (  # of the first format and of its later writers, and numpy's
    ("char", "int8", "i1"),
    ("uchar", "uint8", "u1"),
    ("short", "int16", "i2"),
    ("ushort", "uint16", "u2"),
    ("int", "int32", "i4"),
    ("uint", "uint32", "u4"),
    ("float", "float32", "f4"),
    ("double", "float64", "f8"),
)
_TYPES = {name: kind for *names, kind in _NAMES for name in names}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_BYTES = 1 << 16
_END = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r)")


class Lists(NamedTuple):
    """A list property: the length (n,) of every list, and the values of all, one after another."""

    counts: npt.NDArray[np.int64]
    values: Columns


class _Property(NamedTuple):
    name: str
    kind: str  # numpy type without byte order
    count_kind: str = ""  # of lists


@dataclass
class Element:
    """One kind of element: its number, and the values of its properties."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)
    values: dict[str, Columns | Lists] = field(default_factory=dict)


def read_elements(path: Path, data: bytes) -> dict[str, Element]:
    """The elements of a PLY file by name.

    :raises InputError: no PLY header, an unknown type or format, data cut short, words that are no numbers
    """
    order, elements, at = _header(path, data)
    if not order:
        _read_text(path, data[at:], elements)
    for element in elements if order else ():
        if element.count and element.properties:
            at = _alike(path, data, at, order, element) or _uneven(path, data, at, order, element)
    return {element.name: element for element in elements}


def _header(path: Path, data: bytes) -> tuple[str, list[Element], int]:
    """Byte order ("" for text), elements, and where the data begins."""
    end = _END.search(data[:_HEADER_BYTES])
    if not re.match(rb"ply[ \t]*[\r\n]", data[:8]) or end is None:
        raise InputError(path, "no PLY header, expected 'ply' to 'end_header'")
    order, elements = None, []
    for number, line in enumerate(data[: end.start()].decode("ascii", "replace").splitlines(), 1):
        words = line.split()
        if words[:1] == ["format"] and len(words) == 3 and words[1] in _FORMATS:
            order = _FORMATS[words[1]]
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch("[0-9]{1,10}", words[2]):
            elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(f"{path}:{number}", words[1:], elements[-1]))
        elif words and words[0] not in ("ply", "comment", "obj_info"):
            raise InputError(f"{path}:{number}", f"{line[:60]!r}, expected a line of a PLY header")
    if order is None:
        raise InputError(path, "no format line, expected ascii, binary_little_endian or binary_big_endian")
    if len({element.name for element in elements}) < len(elements):
        raise InputError(path, "an element twice, expected each once")
    return order, elements, end.end()


def _property(where: str, words: list[str], element: Element) -> _Property:
    if words[:1] == ["list"] and len(words) == 4 and words[1] in _TYPES and words[2] in _TYPES:
        new_property = _Property(words[3], _TYPES[words[2]], _TYPES[words[1]])
    elif len(words) == 2 and words[0] in _TYPES:
        new_property = _Property(words[1], _TYPES[words[0]])
    else:
        raise InputError(where, f"property {' '.join(words)[:60]!r}, expected a type and a name")
    if new_property.count_kind.startswith("f") or any(new_property.name == other.name for other in element.properties):
        raise InputError(
            where, f"property {new_property.name[:40]!r}, expected each once, with whole numbers as list counts"
        )
    return new_property


def _alike(path: Path, data: bytes, at: int, order: str, element: Element) -> int | None:
    """Values of an element whose lists, if it has any, are all as long as its first ones; None where they are not."""
    fields: list[tuple[Any, ...]] = []
    place = at
    for column in element.properties:
        if not column.count_kind:
            fields.append((f"value {column.name}", order + column.kind))
            place += np.dtype(column.kind).itemsize
            continue
        count_type = np.dtype(order + column.count_kind)
        if place + count_type.itemsize > len(data):
            return None
        length = int(np.frombuffer(data, count_type, 1, place)[0])
        place += count_type.itemsize + length * np.dtype(column.kind).itemsize
        if length < 0 or place > len(data):
            return None
        fields += [(f"count {column.name}", count_type), (f"value {column.name}", order + column.kind, (length,))]
    layout = np.dtype(fields)
    if layout.itemsize * element.count > len(data) - at:
        if any(column.count_kind for column in element.properties):
            return None
        raise _cut_short(path, element, (len(data) - at) // layout.itemsize)
    rows = np.frombuffer(data, layout, element.count, at)
    for column in element.properties:
        values = rows[f"value {column.name}"].astype(column.kind)
        if column.count_kind:
            counts = rows[f"count {column.name}"].astype(np.int64)
            if (counts != counts[0]).any():
                element.values.clear()
                return None
            element.values[column.name] = Lists(counts, values.reshape(-1))
        else:
            element.values[column.name] = values
    return at + rows.nbytes


def _uneven(path: Path, data: bytes, at: int, order: str, element: Element) -> int:
    """Values of an element with lists of any length, one after another."""
    values_of: dict[str, list[Any]] = {column.name: [] for column in element.properties}
    types = [
        (
            values_of[column.name],
            np.dtype(order + column.kind),
            np.dtype(order + column.count_kind) if column.count_kind else None,
        )
        for column in element.properties
    ]
    for row in range(element.count):
        for values, kind, count_kind in types:
            length = 1
            if count_kind is not None:
                length = int(np.frombuffer(data, count_kind, 1, at)[0]) if at + count_kind.itemsize <= len(data) else -1
                at += count_kind.itemsize
            if length < 0 or at + length * kind.itemsize > len(data):
                raise _cut_short(path, element, row)
            values.append(np.frombuffer(data, kind, length, at))
            at += length * kind.itemsize
    _collect(element, values_of)
    return at


def _cut_short(path: Path, element: Element, there: int) -> InputError:
    return InputError(f"{path} -> {element.name}", f"cut short at {there} of {element.count}")


def _collect(element: Element, values_of: dict[str, list[Any]]) -> None:
    for column in element.properties:
        joined = np.concatenate(values_of[column.name]).astype(column.kind)
        if column.count_kind:
            counts = np.array([len(values) for values in values_of[column.name]], np.int64)
            element.values[column.name] = Lists(counts, joined)
        else:
            element.values[column.name] = joined


def _read_text(path: Path, data: bytes, elements: list[Element]) -> None:
    """Words in a row: where lines end does not count."""
    words, at = data.split(), 0
    for element in elements:
        if element.count == 0 or not element.properties:
            continue
        if len(words) - at < element.count * len(element.properties):
            raise _cut_short(path, element, (len(words) - at) // len(element.properties))
        try:
            at = _text_element(words, at, element)
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path} -> {element.name}", f"{str(error)[:80]}, expected numbers") from None


def _text_element(words: list[bytes], at: int, element: Element) -> int:
    """Values of an element; where the next begins.

    :raises ValueError: cut short, or a word that is no number
    """
    if not any(column.count_kind for column in element.properties):
        width = len(element.properties)
        stop = at + element.count * width
        rows = np.array(list(map(float, words[at:stop])), np.float64).reshape(-1, width)
        for i, column in enumerate(element.properties):
            element.values[column.name] = _typed(rows[:, i], column.kind)
        return stop
    values_of: dict[str, list[Any]] = {column.name: [] for column in element.properties}
    for row in range(element.count):
        for column in element.properties:
            length = 1
            if column.count_kind:
                length, at = int(words[at]) if at < len(words) else 0, at + 1
            if length < 0 or at + length > len(words):
                raise ValueError(f"cut short at {row} of {element.count}")
            values_of[column.name].append(np.array(list(map(float, words[at : at + length])), np.float64))
            at += length
    for column in element.properties:
        values_of[column.name] = [_typed(values, column.kind) for values in values_of[column.name]]
    _collect(element, values_of)
    return at


def _typed(values: npt.NDArray[np.float64], kind: str) -> Columns:
    """:raises ValueError: a number that the type can't hold"""
    if kind.startswith("f"):
        return values
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    if not ((values >= low) & (values <= high)).all():
        raise ValueError(f"a number beyond {low} to {high}")
    return values.astype(kind)
