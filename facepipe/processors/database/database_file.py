"""Face databases on disk (.fpdb): what stands where is in docs/database.md."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError
from facepipe.declare import from_json, json_value
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.processors.database.array_file import read_arrays, write_arrays
from facepipe.processors.database.face_database import REMOVE, Entry, FaceDatabase, StoredError, Update
from facepipe.processors.database.options import quality_from
from facepipe.processors.database.whole_faces import Topology

_Value = TypeVar("_Value")

SUFFIX = ".fpdb"
FORMAT = "facepipe face database 1"


def save_database(database: FaceDatabase, path: str | os.PathLike[str]) -> None:
    """Write a database whole or not at all; the same database is the same bytes.

    :raises InputError: another suffix than .fpdb, or a file that can't be written
    """
    target = check_suffix(path)
    content = {
        "entries": [asdict(entry) for entry in database.entries],
        "history": [asdict(update) for update in database.history],
        "left_out": database.left_out,
        "meshes": database.topology.names,
        "shape_meshes": database.shape_meshes,
        "shapes": database.shapes,
        "tolerance_mm": database.tolerance_mm,
        "units": "mm",
    }
    write_arrays(target, FORMAT, json_value(_plain(content)), _arrays_of(database))


def load_database(path: str | os.PathLike[str]) -> FaceDatabase:
    """Read a database.

    :raises InputError: no such file, no face database, one of a newer facepipe, or a damaged one
    """
    source = check_suffix(path)
    arrays, content = read_arrays(source, FORMAT)
    header = _header_of(content, source)
    reader = _Reader(source, arrays, {"entries": len(header.entries)})
    topology = _topology(reader, header)
    reader.sizes["points"] = topology.point_count
    mean = reader.get("identity/mean", "f", "points", 3)
    identity = IdentityModel(
        mean=mean.astype(np.float64),
        components=reader.get("identity/components", "f", "components", "points", 3),
        deviations=reader.get("identity/deviations", "f", "components"),
        count=len(header.entries),
    )
    if not len(identity.deviations) or not (identity.deviations > 0).all():
        raise InputError(f"{source} -> identity/deviations", "one of 0 or none at all, expected numbers above 0")
    return FaceDatabase(
        topology=topology,
        identity=identity,
        coefficients=reader.get("identity/coefficients", "f", "entries", "components"),
        expressions=_expressions(reader, header, identity) if header.shapes else None,
        shape_meshes=header.shape_meshes,
        left_out=header.left_out,
        entries=header.entries,
        history=header.history,
        tolerance_mm=header.tolerance_mm,
    )


def check_suffix(path: str | os.PathLike[str]) -> Path:
    """:raises InputError: another suffix than .fpdb"""
    file = Path(path)
    if file.suffix.lower() != SUFFIX:
        raise InputError(file, f"suffix '{file.suffix}', expected {SUFFIX}")
    return file


def _plain(value: Any) -> Any:
    """Numbers as JSON holds them: numpy's are none."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def _arrays_of(database: FaceDatabase) -> dict[str, AnyArray]:
    """Array name -> array: what is as large as points in float32, the rest in float64."""
    identity, model = database.identity, database.expressions
    arrays: dict[str, AnyArray] = {
        "identity/mean": identity.mean.astype(np.float32),
        "identity/components": identity.components.astype(np.float32),
        "identity/deviations": identity.deviations,
        "identity/coefficients": database.coefficients,
        "topology/points": np.array(database.topology.points, np.int32),
    }
    for number, (counts, indices) in enumerate(zip(database.topology.counts, database.topology.indices, strict=True)):
        arrays[f"topology/{number}/counts"] = counts
        arrays[f"topology/{number}/indices"] = indices
    if model is not None:
        arrays |= {
            "expressions/basis": model.basis.astype(np.float32),
            "expressions/mean": model.mean,
            "expressions/core": model.core,
            "expressions/matrix": model.matrix,
            "expressions/vectors": model.vectors,
        }
    return arrays


def _topology(reader: _Reader, header: _Header) -> Topology:
    reader.sizes["meshes"] = len(header.meshes)
    points = reader.get("topology/points", "i", "meshes")
    counts = [reader.get(f"topology/{n}/counts", "i", f"faces {n}") for n in range(len(points))]
    indices = [reader.get(f"topology/{n}/indices", "i", f"corners {n}") for n in range(len(points))]
    for name, size, faces, corners in zip(header.meshes, points, counts, indices, strict=True):
        sound = size >= 0 and (faces >= 0).all() and int(faces.sum(dtype=np.int64)) == len(corners)
        if not sound or (len(corners) and not (corners.min() >= 0 and corners.max() < size)):
            raise InputError(f"{reader.path} -> {name}", "faces that don't fit its points, expected a sound mesh")
    return Topology(
        names=header.meshes, points=tuple(int(size) for size in points), counts=tuple(counts), indices=tuple(indices)
    )


def _expressions(reader: _Reader, header: _Header, identity: IdentityModel) -> ExpressionModel:
    sizes = reader.sizes
    sizes["rows"] = len(header.shapes) + 1
    sizes["people"] = sum(entry.stored_error is not None for entry in header.entries)
    basis = reader.get("expressions/basis", "f", "basis", "points", 3)
    sizes["coordinates"] = sizes["components"] + sizes["basis"]
    return ExpressionModel(
        names=header.shapes,
        identity=identity,
        basis=basis,
        mean=reader.get("expressions/mean", "f", "rows", "coordinates"),
        core=reader.get("expressions/core", "f", "numbers", "factors", "coordinates"),
        matrix=reader.get("expressions/matrix", "f", "rows", "factors"),
        vectors=reader.get("expressions/vectors", "f", "people", "numbers"),
    )


class _Reader:
    """Arrays by name, whose sizes agree."""

    def __init__(self, path: Path, arrays: Mapping[str, AnyArray], sizes: dict[str, int]) -> None:
        self.path, self._arrays, self.sizes = path, arrays, sizes

    def get(self, name: str, kind: str, *shape: str | int) -> AnyArray:
        """:raises InputError: no such array, or one of another kind or shape; a size met first holds for all"""
        where = f"{self.path} -> {name}"
        if name not in self._arrays:
            raise InputError(where, "array is missing")
        array = self._arrays[name]
        if array.dtype.kind != kind or len(array.shape) != len(shape):
            raise InputError(where, f"array of {array.dtype} with {array.ndim} axes, expected {len(shape)}")
        for size, axis in zip(array.shape, shape, strict=True):
            expected = axis if isinstance(axis, int) else self.sizes.setdefault(axis, size)
            if size != expected:
                raise InputError(where, f"array of shape {array.shape}, expected {expected} {axis}")
        return array


@dataclass(frozen=True, kw_only=True)
class _Header:
    """What the JSON says."""

    meshes: tuple[str, ...]
    shapes: tuple[str, ...]
    shape_meshes: dict[str, tuple[str, ...]]
    left_out: dict[str, tuple[str, ...]]
    entries: tuple[Entry, ...]
    history: tuple[Update, ...]
    tolerance_mm: float


def _header_of(content: dict[str, Any], path: Path) -> _Header:
    """Read the JSON.

    :raises InputError: a value is missing or of another type, a name is there twice, or versions don't ascend
    """
    members = _Object(content, str(path))
    entries = members.read("entries", lambda value, where: _each(value, where, _entry))
    history = members.read("history", lambda value, where: _each(value, where, _update))
    tolerance = members.read("tolerance_mm", _number)
    header = _Header(
        meshes=members.read("meshes", _names),
        shapes=members.read("shapes", _names),
        shape_meshes=members.read("shape_meshes", _name_lists),
        left_out=members.read("left_out", _name_lists),
        entries=entries,
        history=history,
        tolerance_mm=tolerance,
    )
    _check_header(header, path)
    return header


def _check_header(header: _Header, path: Path) -> None:
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
    members = _Object(value, where)
    return Entry(
        name=members.read("name", _text),
        source=members.read("source", _text),
        digest=members.read("digest", _text),
        content=members.read("content", _text),
        version=members.read("version", _whole),
        stored_error=members.read("stored_error", _or_none(lambda one, there: from_json(StoredError, one, there))),
        quality=members.read("quality", _or_none(quality_from)),
    )


def _update(value: Any, where: str) -> Update:
    members = _Object(value, where)
    return Update(
        version=members.read("version", _whole),
        verb=members.read("verb", _text),
        entries=members.read("entries", _names),
        dropped=members.read("dropped", _names),
        ignored=members.read("ignored", lambda one, there: _each(one, there, _text)),
        facepipe=members.read("facepipe", _text),
    )


class _Object:
    """A JSON object whose members are read by name."""

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise InputError(where, "no object, expected one")
        self._value, self._where = value, where

    def read(self, name: str, reader: Callable[[Any, str], _Value]) -> _Value:
        if name not in self._value:
            raise InputError(self._where, f"no '{name}', expected one")
        return reader(self._value[name], f"{self._where} -> {name}")


def _each(value: Any, where: str, reader: Callable[[Any, str], _Value]) -> tuple[_Value, ...]:
    if not isinstance(value, list):
        raise InputError(where, "no list, expected one")
    return tuple(reader(one, f"{where} -> {number}") for number, one in enumerate(value))


def _or_none(reader: Callable[[Any, str], _Value]) -> Callable[[Any, str], _Value | None]:
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
    names = _each(value, where, _text)
    if len(set(names)) != len(names):
        raise InputError(where, "a name twice, expected each once")
    return names


def _name_lists(value: Any, where: str) -> dict[str, tuple[str, ...]]:
    if not isinstance(value, dict):
        raise InputError(where, "no object, expected one")
    return {name: _names(names, f"{where} -> {name}") for name, names in value.items()}
