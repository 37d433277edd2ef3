"""Face databases on disk (.fpdb): what stands where is in docs/database.md."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.declare import json_value
from facepipe.geometry.expression_model import ExpressionModel
from facepipe.geometry.identity_model import IdentityModel
from facepipe.processors.database.array_file import read_arrays, write_arrays
from facepipe.processors.database.content_json import Header, header_of
from facepipe.processors.database.face_database import FaceDatabase
from facepipe.processors.database.whole_faces import Topology

Array = npt.NDArray[Any]

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
    header = header_of(content, source)
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
    found = Path(path)
    if found.suffix.lower() != SUFFIX:
        raise InputError(found, f"suffix '{found.suffix}', expected {SUFFIX}")
    return found


def _plain(value: Any) -> Any:
    """Numbers as JSON holds them: numpy's are none."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def _arrays_of(database: FaceDatabase) -> dict[str, Array]:
    """Array name -> array: what is as large as points in float32, the rest in float64."""
    identity, model = database.identity, database.expressions
    arrays: dict[str, Array] = {
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


def _topology(reader: _Reader, header: Header) -> Topology:
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


def _expressions(reader: _Reader, header: Header, identity: IdentityModel) -> ExpressionModel:
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

    def __init__(self, path: Path, arrays: Mapping[str, Array], sizes: dict[str, int]) -> None:
        self.path, self._arrays, self.sizes = path, arrays, sizes

    def get(self, name: str, kind: str, *shape: str | int) -> Array:
        """:raises InputError: no such array, or one of another kind or shape; a size met first holds for all"""
        where = f"{self.path} -> {name}"
        if name not in self._arrays:
            raise InputError(where, "array is missing")
        found = self._arrays[name]
        if found.dtype.kind != kind or len(found.shape) != len(shape):
            raise InputError(where, f"array of {found.dtype} with {found.ndim} axes, expected {len(shape)}")
        for size, axis in zip(found.shape, shape, strict=True):
            expected = axis if isinstance(axis, int) else self.sizes.setdefault(axis, size)
            if size != expected:
                raise InputError(where, f"array of shape {found.shape}, expected {expected} {axis}")
        return found
