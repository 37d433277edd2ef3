"""The package data: a real head in numbers. `samples/head/build.py` makes it of ICT-FaceKit and MakeHuman.

Points of the whole head are numbered as in ICT-FaceKit, whose points 0 to 24590 are kept; a mesh is a run of them.
Lengths are in centimetres, Y is up, the head looks along +Z, +X is its left.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import as_file, files
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.payload.basis import BasisContent, decode_basis

ATTRIBUTION = (
    "Head: ICT-FaceKit, Copyright (c) 2020 USC Institute for Creative Technologies, MIT license. Please cite: Li et "
    "al., Learning Formation of Physically-Based Face Attributes, CVPR 2020. Skin weights: MakeHuman team, CC0 1.0."
)
STEP = 0.001  # cm: of packed offsets
BASIS = "head.fpbasis"
IDENTITY_MODES = 100  # of the basis's modes: those after them are of what is fitted to a person


@dataclass(frozen=True, kw_only=True)
class Part:
    """A mesh: its run of points and of faces, and the region that it lies in ("" for Head, which has its own masks)."""

    points: slice
    faces: slice
    corners: slice
    region: str


@dataclass(frozen=True, kw_only=True)
class Asset:
    """n points, f faces, c face corners, m modes, j joints."""

    points: FloatArray  # (n, 3) the average head; the basis's mean to 5e-6 mm, which tips ties of nearest points
    basis: BasisContent  # of persons as payloads: the average head, the m identity modes, and some of what is fitted
    basis_digest: bytes
    shapes: Mapping[str, Mapping[float, npt.NDArray[np.float32]]]  # name -> weight, 1 the last -> (n, 3) offsets there
    parts: Mapping[str, Part]  # by name of the mesh
    counts: IntArray  # (f,)
    indices: IntArray  # (c,)
    uvs: FloatArray  # (u, 2): the integer part of u is the texture tile
    uv_indices: IntArray  # (c,)
    materials: IntArray  # (f,) into material_names
    material_names: tuple[str, ...]
    regions: Mapping[str, FloatArray]  # name -> (points of Head,) soft masks, which sum to 1
    landmarks: IntArray  # (68,) points of multipie68
    dense: IntArray  # (204,) points of dense, all over the face
    anchor: int
    joints: tuple[str, ...]  # paths, parents first
    joint_points: IntArray  # (j, k) of whose places each joint is
    joint_shares: FloatArray  # (j, k) the weighted mean
    skin_joints: IntArray  # (n, 4)
    skin_weights: FloatArray  # (n, 4)

    @cached_property
    def modes(self) -> npt.NDArray[np.float32]:
        """(m, n, 3) offsets of a standard deviation."""
        modes = np.empty((IDENTITY_MODES, len(self.points), 3), np.float32)
        for steps, offsets in zip(self.basis.modes, modes, strict=False):
            np.multiply(steps.T, np.float32(STEP), out=offsets)
        return modes

    def person(self, identity: FloatArray) -> FloatArray:
        """(n, 3) points by (m,) standard deviations of the modes, one after another: all as numbers are 30 MB."""
        total = np.zeros(self.basis.modes.shape[1:])
        for weight, steps in zip(np.asarray(identity, np.float64).tolist(), self.basis.modes, strict=False):
            total += weight * steps
        return self.points + STEP * total.T

    def place(self, point: int) -> tuple[str, int]:
        """The mesh that a point is in, and its number there."""
        return next((name, point - part.points.start) for name, part in self.parts.items() if point < part.points.stop)

    @cached_property
    def links(self) -> Any:
        """Sparse (n, n), above 0 where an edge of a face joins two points."""
        from scipy.sparse import coo_array

        ends = np.cumsum(self.counts)
        following = np.arange(1, len(self.indices) + 1)
        following[ends - 1] = ends - self.counts
        pairs, count = (self.indices, self.indices[following]), len(self.points)
        links = coo_array((np.ones(len(following)), pairs), shape=(count, count)).tocsr()
        return links + links.T


def _read(name: str, start: str = "") -> dict[str, npt.NDArray[Any]]:
    with as_file(files("facepipe.heads") / "data" / f"{name}.npz") as path, np.load(path, allow_pickle=False) as file:
        return {key: file[key] for key in file.files if key.startswith(start)}


@cache
def arrays(name: str) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a file of the package data."""
    return _read(name)


def arrays_of(name: str, start: str) -> dict[str, npt.NDArray[Any]]:
    """Those arrays of a file of the package data whose names begin so, by the rest of their names."""
    return {key.removeprefix(start): values for key, values in _read(name, start).items()}


@cache
def asset() -> Asset:
    """The head, read when it is first asked for."""
    data = _read("head")  # not kept packed too
    basis, digest = decode_basis((files("facepipe.heads") / "data" / BASIS).read_bytes(), BASIS, trusted=True)
    names = [str(name) for name in data["shape_names"]]
    shapes: dict[str, dict[float, npt.NDArray[np.float32]]] = {}
    for name, weight, offsets in zip(names, data["shape_weights"], unpacked(data["shapes"]), strict=True):
        shapes.setdefault(name, {})[float(weight)] = offsets
    masks = data["regions"] / data["regions"].sum(axis=0, dtype=np.float64)
    ends = np.vstack([[0, 0], data["mesh_ends"]])
    corners = np.append(0, np.cumsum(data["counts"], dtype=np.int64))
    return Asset(
        points=data["points"].astype(np.float64),
        basis=basis,
        basis_digest=digest,
        shapes=shapes,
        parts={
            str(name): Part(
                points=slice(*map(int, ends[i : i + 2, 0])),
                faces=slice(*map(int, ends[i : i + 2, 1])),
                corners=slice(*(int(corners[end]) for end in ends[i : i + 2, 1])),
                region=str(data["mesh_regions"][i]),
            )
            for i, name in enumerate(data["meshes"])
        },
        counts=data["counts"].astype(np.int32),
        indices=data["indices"],
        uvs=data["uvs"].astype(np.float64),
        uv_indices=data["uv_indices"],
        materials=data["materials"].astype(np.int32),
        material_names=tuple(map(str, data["material_names"])),
        regions=dict(zip(map(str, data["region_names"]), masks, strict=True)),
        landmarks=data["landmarks"],
        dense=np.array(json.loads((files("facepipe.heads") / "data" / "dense.json").read_text()), np.int32),
        anchor=int(data["anchor"]),
        joints=tuple(map(str, data["joints"])),
        joint_points=data["joint_points"],
        joint_shares=data["joint_shares"].astype(np.float64),
        skin_joints=data["skin_joints"].astype(np.int32),
        skin_weights=data["skin_weights"] / data["skin_weights"].sum(axis=1, keepdims=True, dtype=np.float64),
    )


def unpacked(planes: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Offsets (r, n, 3) in cm of low and high bytes (2, r, 3, n) of their differences from point to point, in steps.

    Differences are folded, so that small ones of either sign are small numbers: 0, -1, 1, -2 ... as 0, 1, 2, 3 ...
    """
    _, count, _, points = planes.shape
    result = np.empty((count, points, 3), np.float32)
    for low, high, offsets in zip(*planes, result, strict=True):  # each in the cache: all at once took 3 times as long
        np.multiply(_steps(low, high).T, np.float32(STEP), out=offsets)
    return result


def _steps(low: npt.NDArray[np.uint8], high: npt.NDArray[np.uint8]) -> npt.NDArray[np.int16]:
    """(3, n) of a mode."""
    folded = high.astype(np.uint16) << 8 | low
    change = (folded >> 1).view(np.int16) ^ -(folded & 1).view(np.int16)
    return np.cumsum(change, axis=1, dtype=np.int16)
