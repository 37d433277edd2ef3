"""Face databases on disk (.fpdb): what stands where is in docs/database.md."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from facepipe.core.arrays import AnyArray
from facepipe.core.errors import InputError
from facepipe.declare import from_json
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.scanning.database.face_database import REMOVE, Entry, FaceDatabase, Update
from facepipe.verbs.array_file import read_arrays, write_arrays
from facepipe.verbs.whole_faces import Topology

SUFFIX = ".fpdb"
FORMAT = "facepipe face database 1"


def save_database(database: FaceDatabase, path: str | os.PathLike[str]) -> None:
    """Write a database whole or not at all; the same database is the same bytes.

    :raises InputError: another suffix than .fpdb, or a file that can't be written
    """
    target = check_suffix(path)
    header = _Header(
        meshes=database.topology.names,
        shapes=database.shapes,
        shape_meshes=database.shape_meshes,
        left_out=database.left_out,
        entries=database.entries,
        history=database.history,
        tolerance_mm=database.tolerance_mm,
    )
    identity, model = database.identity, database.expressions
    arrays: dict[str, AnyArray] = {  # what is as large as points in float32, the rest in float64
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
    write_arrays(target, FORMAT, asdict(header), arrays)


def load_database(path: str | os.PathLike[str]) -> FaceDatabase:
    """Read a database.

    :raises InputError: no such file, no face database, one of a newer facepipe, or a damaged one
    """
    source = check_suffix(path)
    arrays, content = read_arrays(source, FORMAT)
    header = from_json(_Header, content, str(source))
    if len(header.entries) < 2 or not header.meshes:
        raise InputError(source, "fewer than two entries or no mesh, expected a face database")
    for key, names in (
        ("entries", [entry.name for entry in header.entries]),
        ("meshes", header.meshes),
        ("shapes", header.shapes),
    ):
        if len(set(names)) != len(names):
            raise InputError(f"{source} -> {key}", "a name twice, expected each once")
    if [update.version for update in header.history] != list(range(1, len(header.history) + 1)):
        raise InputError(f"{source} -> history", "versions that don't count from 1")
    if _names_after(header.history) != [entry.name for entry in header.entries]:
        raise InputError(f"{source} -> history", "other entries than there are")
    if not header.tolerance_mm > 0:
        raise InputError(f"{source} -> tolerance_mm", f"{header.tolerance_mm}, expected a number above 0")
    # A size that is met first holds for all arrays after it: none is broadcast by mistake.
    reader = _Reader(source, arrays, {"entries": len(header.entries)})
    reader.sizes["meshes"] = len(header.meshes)
    points = reader.get("topology/points", "i", "meshes")
    counts = [reader.get(f"topology/{n}/counts", "i", f"faces {n}") for n in range(len(points))]
    indices = [reader.get(f"topology/{n}/indices", "i", f"corners {n}") for n in range(len(points))]
    for name, size, faces, corners in zip(header.meshes, points, counts, indices, strict=True):
        sound = size >= 0 and (faces >= 0).all() and int(faces.sum(dtype=np.int64)) == len(corners)
        if not sound or (len(corners) and not (corners.min() >= 0 and corners.max() < size)):
            raise InputError(f"{reader.path} -> {name}", "faces that don't fit its points, expected a sound mesh")
    topology = Topology(
        names=header.meshes, points=tuple(int(size) for size in points), counts=tuple(counts), indices=tuple(indices)
    )
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
    """The JSON."""

    meshes: tuple[str, ...]
    shapes: tuple[str, ...]
    shape_meshes: Mapping[str, tuple[str, ...]]
    left_out: Mapping[str, tuple[str, ...]]
    entries: tuple[Entry, ...]
    history: tuple[Update, ...]
    tolerance_mm: float
    units: str = "mm"


def _names_after(history: tuple[Update, ...]) -> list[str]:
    """Names of the entries that updates leave."""
    names: list[str] = []
    for update in history:
        if update.verb == REMOVE:
            names = [name for name in names if name not in update.entries]
        else:
            names += update.entries
    return names
