"""The ICT-FaceKit model as arrays, from its OBJ folder or from the packed .npz; both give the same numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.policy.paths import check_found
from facepipe.core.reading import file_beside
from facepipe.importers import ict_topology as topology
from facepipe.importers.npz import Field, check_indices, read_arrays
from facepipe.importers.wavefront import Obj, read_obj, read_offsets

NEUTRAL = "generic_neutral_mesh.obj"

_BASE = {
    "neutral": Field("float", ("V", 3)),
    "face_vertex_counts": Field("int", ("F",)),
    "face_vertex_indices": Field("int", ("C",)),
    "uv": Field("float", ("U", 2)),
    "face_uv_indices": Field("int", ("C",)),
    "face_material": Field("int", ("F",)),
    "material_names": Field("str", ("M",)),
}


@dataclass(frozen=True, kw_only=True)
class IctModel:
    """What was read: V = 26719 points, whole model in one index space."""

    neutral: Obj  # the generic one
    identity: FloatArray  # (V, 3) offsets of the weighted identity modes
    shapes: Mapping[str, FloatArray]  # name -> (V, 3) offsets
    files: tuple[Path, ...]  # that were read
    warnings: tuple[str, ...] = ()


def read_model(source: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    """Read the generic neutral, the identity modes with their weights, and the named shapes that are there.

    :param source: a FaceXModel folder, an ICT-FaceKit checkout, or the packed .npz
    :raises InputError: no neutral, a weighted mode that is missing, or a file that can't be used
    :raises TopologyError: not the ICT-FaceKit topology
    """
    if not source.is_dir():
        return _read_npz(source, identity, shapes)
    inner = source / "FaceXModel"
    check_found(inner, source)
    return _read_folder(inner if inner.is_dir() else source, identity, shapes)


def _read_npz(path: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    sizes = {"V": topology.POINT_COUNT, "F": topology.FACE_COUNT}
    arrays = read_arrays(path, _BASE, sizes)
    _check(path, arrays)
    offsets: dict[str, FloatArray] = {}
    for kind in ("expression", "extra"):
        if kind == "expression" or set(topology.EXTRAS) & set(shapes):
            offsets |= _named_offsets(path, kind, sizes)
    modes = _named_offsets(path, "identity", sizes) if identity else {}
    _require(path, identity, modes)
    return IctModel(
        neutral=Obj(
            points=arrays["neutral"].astype(np.float64),
            face_vertex_counts=arrays["face_vertex_counts"].astype(np.int32),
            face_vertex_indices=arrays["face_vertex_indices"].astype(np.int32),
            uvs=arrays["uv"].astype(np.float64),
            uv_indices=arrays["face_uv_indices"].astype(np.int32),
            materials=tuple(arrays["material_names"].tolist()),
            face_material=arrays["face_material"].astype(np.int32),
        ),
        identity=_weighted({name: modes[name] for name in identity}, identity),
        shapes={name: offsets[name] for name in shapes if name in offsets},
        files=(path,),
        warnings=_missing([name for name in shapes if name not in offsets]),
    )


def _named_offsets(path: Path, kind: str, sizes: dict[str, int]) -> dict[str, FloatArray]:
    axis = f"{kind} names"
    fields = {f"{kind}_names": Field("str", (axis,)), f"{kind}_deltas": Field("float", (axis, "V", 3))}
    arrays = read_arrays(path, fields, sizes)
    names = arrays[f"{kind}_names"].tolist()
    if len(set(names)) != len(names):
        raise InputError(f"{path} -> {kind}_names", "a name occurs twice, expected each once")
    return dict(zip(names, arrays[f"{kind}_deltas"], strict=True))


def _check(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    counts = arrays["face_vertex_counts"]
    corners = len(arrays["face_vertex_indices"])
    if counts.min() < 3 or counts.max() > corners or int(counts.sum(dtype=np.int64)) != corners:
        raise InputError(f"{path} -> face_vertex_counts", f"counts don't add up to the {corners} corners there are")
    check_indices(f"{path} -> face_vertex_indices", arrays["face_vertex_indices"], len(arrays["neutral"]))
    check_indices(f"{path} -> face_uv_indices", arrays["face_uv_indices"], len(arrays["uv"]))
    check_indices(f"{path} -> face_material", arrays["face_material"], len(arrays["material_names"]))


def _read_folder(folder: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    neutral_file = file_beside(folder, NEUTRAL)
    if neutral_file is None:
        raise InputError(folder, f"no {NEUTRAL} there, expected the FaceXModel folder of ICT-FaceKit")
    neutral = read_obj(neutral_file)
    if (len(neutral.points), len(neutral.face_vertex_counts)) != (topology.POINT_COUNT, topology.FACE_COUNT):
        raise TopologyError(
            neutral_file,
            f"{len(neutral.points)} points and {len(neutral.face_vertex_counts)} faces, expected "
            f"{topology.POINT_COUNT} and {topology.FACE_COUNT}",
        )
    modes = [file for name in identity if (file := file_beside(folder, f"{name}.obj"))]
    _require(folder, identity, {path.stem: path for path in modes})
    shape_files = [file for name in shapes if (file := file_beside(folder, f"{name}.obj"))]
    return IctModel(
        neutral=replace(
            neutral,
            points=neutral.points.astype(np.float32).astype(np.float64),
            uvs=neutral.uvs.astype(np.float32).astype(np.float64),
        ),
        identity=_weighted({path.stem: _offsets(path, neutral) for path in modes}, identity),
        shapes={path.stem: _offsets(path, neutral) for path in shape_files},
        files=(neutral_file, *modes, *shape_files),
        warnings=_missing([name for name in shapes if folder / f"{name}.obj" not in shape_files]),
    )


def _offsets(path: Path, neutral: Obj) -> FloatArray:
    """Rounded to 7 decimals like the packed form: the OBJ files carry six digits."""
    return np.round(read_offsets(path, neutral), 7).astype(np.float32)


def _weighted(modes: Mapping[str, FloatArray], weights: Mapping[str, float]) -> FloatArray:
    total = np.zeros((topology.POINT_COUNT, 3))
    for name in sorted(weights):
        total += weights[name] * modes[name].astype(np.float64)
    return total


def _require(where: Path, identity: Mapping[str, float], modes: Mapping[str, object]) -> None:
    for name in identity:
        if name not in modes:
            raise InputError(f"{where} -> {name}", "identity mode is missing")


def _missing(names: Sequence[str]) -> tuple[str, ...]:
    return (f"shapes not in the source, left out: {', '.join(names)}",) if names else ()
