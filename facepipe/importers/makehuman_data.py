"""The packed MakeHuman head (hm08 base mesh) as checked arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.importers.npz import Field, check_indices, read_arrays

Arrays = dict[str, npt.NDArray[Any]]

_FIELDS = {
    "vertices": Field("float", ("V", 3)),
    "source_vertex_index": Field("int", ("V",)),
    "vertex_kind": Field("int", ("V",)),
    "vertex_kind_names": Field("str", ("kinds",)),
    "faces": Field("int", ("F", 4)),
    "face_kind": Field("int", ("F",)),
    "uv": Field("float", ("U", 2)),
    "face_uv": Field("int", ("F", 4)),
    "bone_names": Field("str", ("B",)),
    "bone_parent": Field("int", ("B",)),
    "bone_plane_points": Field("float", ("B", 3, 3)),
    "bone_head": Field("float", ("B", 3)),
    "bone_tail": Field("float", ("B", 3)),
    "bone_head_vertices_offset": Field("int", ("B+1",)),
    "bone_head_vertices": Field("int", ("head vertices",)),
    "bone_tail_vertices_offset": Field("int", ("B+1",)),
    "bone_tail_vertices": Field("int", ("tail vertices",)),
    "skin_weights": Field("float", ("V", "B")),
    "target_names": Field("str", ("T",)),
    "target_offset": Field("int", ("T+1",)),
    "target_vertex": Field("int", ("D",)),
    "target_delta": Field("float", ("D", 3)),
    "region_names": Field("str", ("R",)),
    "region_strength": Field("float", ("R", "V")),
    "poseunit_names": Field("str", ("P",)),
    "poseunit_rotvec": Field("float", ("P", "B", 3)),
}


@dataclass(frozen=True)
class MakeHumanData:
    """The arrays of the archive, by the names of its README, in the units of the base mesh (decimetres)."""

    path: Path
    arrays: Arrays

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self.arrays[name]

    def names(self, name: str) -> list[str]:
        """An array of strings as a list."""
        return [str(item) for item in self.arrays[name].tolist()]

    def points_of(self, kind: str) -> IntArray:
        """Ascending vertex numbers of one kind (``skin``, ``eye_left`` ...)."""
        return np.flatnonzero(self["vertex_kind"] == self.names("vertex_kind_names").index(kind))

    def target(self, number: int) -> FloatArray:
        """(V, 3) float64 deltas of one target."""
        start, end = (int(self["target_offset"][number + i]) for i in (0, 1))
        deltas = np.zeros(self["vertices"].shape)
        np.add.at(deltas, self["target_vertex"][start:end], self["target_delta"][start:end].astype(np.float64))
        return deltas


def read_data(path: Path) -> MakeHumanData:
    """Read and check the packed head.

    :raises InputError: an array that is missing, or values out of range
    :raises TopologyError: a face that joins vertices of two kinds
    """
    data = MakeHumanData(path, read_arrays(path, _FIELDS, {}))
    _check_mesh(data)
    _check_bones(data)
    _check_targets(data)
    return data


def _check_mesh(data: MakeHumanData) -> None:
    count = len(data["vertices"])
    for name, limit in (
        ("faces", count),
        ("face_uv", len(data["uv"])),
        ("vertex_kind", len(data["vertex_kind_names"])),
        ("face_kind", len(data["vertex_kind_names"])),
    ):
        check_indices(f"{data.path} -> {name}", data[name], limit)
    _check_unique(data, "vertex_kind_names")
    if "skin" not in data.names("vertex_kind_names"):
        raise InputError(f"{data.path} -> vertex_kind_names", "no kind skin there")
    mixed = (data["vertex_kind"][data["faces"]] != data["face_kind"][:, None]).any(axis=1)
    if mixed.any():
        raise TopologyError(f"{data.path} -> faces", f"face {int(np.argmax(mixed))} joins vertices of two kinds")
    if (data["region_strength"] < 0).any():
        raise InputError(f"{data.path} -> region_strength", "negative strength, expected 0 or more")


def _check_bones(data: MakeHumanData) -> None:
    parents = data["bone_parent"]
    if len(parents) == 0 or parents[0] != -1 or (parents >= np.arange(len(parents))).any() or parents.min() < -1:
        raise InputError(f"{data.path} -> bone_parent", "expected a root first and every parent before its children")
    _check_unique(data, "bone_names")
    for end in ("head", "tail"):
        name = f"bone_{end}_vertices"
        check_indices(f"{data.path} -> {name}", data[name], len(data["vertices"]))
        _check_offsets(data, f"{name}_offset", len(data[name]), at_least=1)
    weights = data["skin_weights"]
    on_surface = np.unique(data["faces"])
    if (weights < 0).any() or (np.abs(weights[on_surface].sum(axis=1) - 1) > 1e-3).any():
        raise InputError(f"{data.path} -> skin_weights", "expected weights of 0 or more that sum to 1 per point")


def _check_targets(data: MakeHumanData) -> None:
    _check_unique(data, "target_names")
    check_indices(f"{data.path} -> target_vertex", data["target_vertex"], len(data["vertices"]))
    _check_offsets(data, "target_offset", len(data["target_vertex"]), at_least=0)
    _check_unique(data, "poseunit_names")
    _check_unique(data, "region_names")


def _check_offsets(data: MakeHumanData, name: str, end: int, at_least: int) -> None:
    offsets = data[name].astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != end or (np.diff(offsets) < at_least).any():
        raise InputError(f"{data.path} -> {name}", f"expected ascending offsets from 0 to {end}")


def _check_unique(data: MakeHumanData, name: str) -> None:
    names = data.names(name)
    if len(set(names)) != len(names):
        raise InputError(f"{data.path} -> {name}", "a name occurs twice, expected each once")
