"""PLY files: meshes and point clouds with normals and colours, as scanners and photogrammetry write them.

A reader of our own, since trimesh's refuses binary files whose faces differ in size, follows counts of the header
without a bound, splits points by texture coordinates, knows fewer kinds of colours and lets NaN through. Elements
other than ``vertex`` and ``face`` are skipped. Format: Turk, "The PLY Polygon File Format", 1994; property names as
MeshLab, CloudCompare, Open3D and Blender write them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.core.reading import read_bytes
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import point_triangles
from facepipe.importers.wavefront import LARGEST
from facepipe.scans import Scan, no_triangles

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
MOST_BYTES = 1 << 31
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_FACES = ("vertex_indices", "vertex_index")
_NEW_STRIP = -1  # in a list of triangle strips: the next index begins another


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
            element, where = elements[-1], f"{path}:{number}"
            if words[1:2] == ["list"] and len(words) == 5 and words[2] in _TYPES and words[3] in _TYPES:
                column = _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
            elif len(words) == 3 and words[1] in _TYPES:
                column = _Property(words[2], _TYPES[words[1]])
            else:
                raise InputError(where, f"property {' '.join(words[1:])[:60]!r}, expected a type and a name")
            if column.count_kind.startswith("f") or any(column.name == other.name for other in element.properties):
                what = f"property {column.name[:40]!r}, expected each once, with whole numbers as list counts"
                raise InputError(where, what)
            element.properties.append(column)
        elif words and words[0] not in ("ply", "comment", "obj_info"):
            raise InputError(f"{path}:{number}", f"{line[:60]!r}, expected a line of a PLY header")
    if order is None:
        raise InputError(path, "no format line, expected ascii, binary_little_endian or binary_big_endian")
    if len({element.name for element in elements}) < len(elements):
        raise InputError(path, "an element twice, expected each once")
    return order, elements, end.end()


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
            if any(column.count_kind for column in element.properties):
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
            else:  # rows of one length at once
                stop = at + element.count * len(element.properties)
                rows = np.array(list(map(float, words[at:stop])), np.float64).reshape(element.count, -1)
                for i, column in enumerate(element.properties):
                    element.values[column.name] = _typed(rows[:, i], column.kind)
                at = stop
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path} -> {element.name}", f"{str(error)[:80]}, expected numbers") from None


def _typed(values: npt.NDArray[np.float64], kind: str) -> Columns:
    """:raises ValueError: a number that the type can't hold"""
    if kind.startswith("f"):
        return values
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    if not ((values >= low) & (values <= high)).all():
        raise ValueError(f"a number beyond {low} to {high}")
    return values.astype(kind)


def read_ply(path: Path) -> Scan:
    """The points of `path`, with its triangles where it has faces.

    Faces of any size become fans of triangles; strips of triangles are read too. Colours are sRGB in the file: whole
    numbers over the range of their type, or floats in 0..1. Normals are made unit length; where one is not, all are
    left out.

    :raises InputError: no PLY, cut short, without points, indices out of range, NaN or infinity
    """
    data = read_bytes(path, MOST_BYTES)
    order, listed, start = _header(path, data)
    if not order:
        _read_text(path, data[start:], listed)
    for element in listed if order else ():
        if element.count and element.properties:
            start = _alike(path, data, start, order, element) or _uneven(path, data, start, order, element)
    elements = {element.name: element for element in listed}
    vertices = elements.get("vertex")
    if vertices is None or vertices.count == 0:
        raise InputError(path, "no vertices, expected a PLY mesh or point cloud")
    points = _columns(vertices, ("x", "y", "z"))
    if points is None:
        raise InputError(f"{path} -> vertex", "lacks x, y or z, expected all three")
    _check(f"{path} -> vertex", points)
    triangles = _triangles(path, elements, len(points))
    normals, colors = _columns(vertices, ("nx", "ny", "nz")), None
    if normals is not None:
        _check(f"{path} -> vertex normals", normals)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.asarray(normals / lengths) if (lengths > 0).all() else None
    found = next((found for names in _COLORS if (found := _scalars(vertices, names)) is not None), None)
    if found is not None:
        tops = [np.iinfo(one.dtype).max if one.dtype.kind in "iu" else 1.0 for one in found]
        values = np.stack([one / top for one, top in zip(found, tops, strict=True)], axis=1)
        _check(f"{path} -> vertex colours", values)
        colors = from_srgb(np.clip(values, 0.0, 1.0))
    return Scan(name=path.stem, points=points, triangles=triangles, normals=normals, colors=colors)


def _triangles(path: Path, elements: dict[str, Element], points: int) -> IntArray:
    """(t, 3) of faces and of triangle strips.

    :raises InputError: corners that are no list of indices from 0 to `points`
    """
    found = [no_triangles()]
    for name, parts in (("face", point_triangles), ("tristrips", _strip_triangles)):
        element = elements.get(name)
        if element is None or not element.count:
            continue
        lists = next((element.values[one] for one in _FACES if one in element.values), None)
        if not isinstance(lists, Lists):
            raise InputError(f"{path} -> {name}", "no list vertex_indices, expected the corners of each face")
        used = lists.values.astype(np.int64)
        bad = (used < (_NEW_STRIP if name == "tristrips" else 0)) | (used >= points)
        if bad.any():
            at = int(np.argmax(bad))
            row = int(np.searchsorted(np.cumsum(lists.counts), at, side="right"))
            raise InputError(f"{path} -> {name} {row}", f"vertex {used[at]}, expected 0 to {points - 1}")
        found.append(np.asarray(parts(lists.counts, used), np.int32))
    return np.concatenate(found)


def _strip_triangles(counts: IntArray, indices: IntArray) -> IntArray:
    """(t, 3) of strips, every second triangle of which runs the other way round; -1 begins another strip."""
    first = np.zeros(len(indices), bool)  # of a strip
    starts = np.cumsum(counts) - counts
    first[starts[starts < len(indices)]] = True
    first[1:] |= indices[:-1] == _NEW_STRIP
    begin = np.maximum.accumulate(np.where(first, np.arange(len(indices)), 0))
    rows = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1) if len(indices) > 2 else np.zeros((0, 3), int)
    whole = (begin[2:] == begin[:-2]) & (rows != _NEW_STRIP).all(axis=1)
    odd = (np.arange(len(rows)) - begin[: len(rows)]) % 2 == 1
    rows[odd] = rows[odd][:, [1, 0, 2]]
    distinct = (rows[:, 0] != rows[:, 1]) & (rows[:, 1] != rows[:, 2]) & (rows[:, 2] != rows[:, 0])
    return np.asarray(rows[whole & distinct])  # corners twice in a row only lead a strip on


def write_ply(scan: Scan, path: Path) -> None:
    """Write `scan` as binary little-endian PLY: float32 points and normals, 8-bit sRGB colours; whole or not at all.

    :raises InputError: the file can't be written, or a number is not finite in float32
    """
    fields: list[tuple[str, str, FloatArray | IntArray]] = _written(scan.points, "x y z")
    if scan.normals is not None:
        fields += _written(scan.normals, "nx ny nz")
    for name, _, values in fields:
        if not np.isfinite(values).all():
            raise InputError(f"{path} -> {name}", "NaN, infinity or beyond float32, expected finite numbers")
    if scan.colors is not None:
        levels = np.rint(to_srgb(scan.colors) * 255).astype(np.uint8)
        fields += [(name, "uchar", levels[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scan.points)}"]
    header += [f"property {kind} {name}" for name, kind, _ in fields]
    rows = np.empty(len(scan.points), [(name, "<f4" if kind == "float" else "u1") for name, kind, _ in fields])
    for name, _, values in fields:
        rows[name] = values
    data = rows.tobytes()
    if not scan.is_cloud:
        header += [f"element face {len(scan.triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(scan.triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, scan.triangles
        data += faces.tobytes()
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii") + data)


def _written(values: FloatArray, names: str) -> list[tuple[str, str, FloatArray | IntArray]]:
    with np.errstate(over="ignore"):
        narrow = np.asarray(values, np.float32)
    return [(name, "float", narrow[:, i]) for i, name in enumerate(names.split())]


def _scalars(element: Element, names: tuple[str, ...]) -> list[Columns] | None:
    """The values of scalar properties; None where one is not there."""
    values = [element.values.get(name) for name in names]
    found = [value for value in values if value is not None and not isinstance(value, Lists)]
    return found if len(found) == len(names) else None


def _columns(element: Element, names: tuple[str, ...]) -> FloatArray | None:
    """(n, 3) float64 of three scalar properties; None where one is not there."""
    found = _scalars(element, names)
    return None if found is None else np.stack(found, axis=1).astype(np.float64)


def _check(where: str, values: FloatArray) -> None:
    """:raises InputError: a row that is not finite"""
    good = (np.abs(values) <= LARGEST).all(axis=1)
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(f"{where} {row}", f"NaN, infinity or over {LARGEST:g}, expected finite numbers")
