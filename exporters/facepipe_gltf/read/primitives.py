"""All primitives of one glTF mesh as one list of vertices and one of triangles.

Source: glTF 2.0 sections 3.7.2 (geometry, primitive modes, attributes, morph targets) and 3.7.3.3 (skinned meshes).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe_gltf.buffers import DRACO
from facepipe_gltf.read import accessors
from facepipe_gltf.read.accessors import Deltas
from facepipe_gltf.read.document import Document, Value
from facepipe_gltf.read.draco import unpacked
from facepipe_gltf.read.variants import Variants

_MAX_SETS = 8
_SETS = [f"{name}_{i}" for name in ("TEXCOORD", "JOINTS", "WEIGHTS") for i in range(_MAX_SETS)]
_KNOWN = {"POSITION", "NORMAL", "TANGENT", "COLOR_0", "COLOR_1", "_FACEPIPE_POINT", *_SETS}  # or named apart
_STILL = Deltas(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
_LARGEST_NUMBER = 2.0**24  # that float32 and all below it hold exactly
TARGET_NOTES = ("extras", "extra", "name")  # beside the attributes of a target: what exporters call it by
_FEWEST_STEPS = 2**11  # of Draco in the larger extent of a primitive, by default of the programs that compress
_MODES = ("points", "lines", "line loop", "line strip", "triangles", "triangle strip", "triangle fan")


@dataclass(frozen=True, kw_only=True)
class Target:
    """One morph target over all vertices of a mesh; only rows that aren't zero."""

    positions: Deltas
    normals: Deltas | None


@dataclass(frozen=True, kw_only=True)
class Vertices:
    """Vertices as the file has them, primitives one after the other."""

    positions: FloatArray  # (n, 3)
    normals: FloatArray | None = None  # (n, 3)
    uvs: dict[int, FloatArray] = field(default_factory=dict)  # TEXCOORD number -> (n, 2), v down
    colors: FloatArray | None = None  # (n, 3)
    joints: IntArray | None = None  # (n, influences) into the skin's joints
    weights: FloatArray | None = None  # (n, influences)
    point_numbers: IntArray | None = None  # (n,) _FACEPIPE_POINT
    targets: tuple[Target, ...] = ()


def _read_vertices(document: Document, primitive: Value, skinned: bool) -> Vertices:
    """The vertices of one primitive.

    :raises InputError: attributes or targets of other lengths, or values that can't be
    """
    attributes = primitive.require("attributes")
    positions = accessors.floats(document, attributes.require("POSITION"), "VEC3")
    count = len(positions)
    joints, weights = _influences(document, primitive, attributes, count) if skinned else (None, None)
    if not skinned and attributes.get("JOINTS_0") is not None:
        document.warn(primitive, "has skin weights, but its node has no skin: they are left out")
    for name in attributes.member_names():
        if name not in _KNOWN:
            document.warn(primitive, f"the attribute {ascii(name)[:40]} is left out")
    normals, uvs, colors, numbers = None, {}, None, None
    if (normal := attributes.get("NORMAL")) is not None:
        normals = accessors.floats(document, normal, "VEC3", count=count)
    for number in range(_MAX_SETS):
        if (uv := attributes.get(f"TEXCOORD_{number}")) is not None:
            uvs[number] = accessors.floats(document, uv, "VEC2", count=count)
    if attributes.get("COLOR_1") is not None:
        document.warn(primitive, "colours beyond COLOR_0 are left out")
    if (color := attributes.get("COLOR_0")) is not None:
        colors = accessors.floats(document, color, "VEC3", "VEC4", count=count)
        if colors.shape[1] == 4 and np.any(colors[:, 3] != 1.0):
            document.warn(color, "the alpha of vertex colours is left out")
        colors = colors[:, :3]
    if (point := attributes.get("_FACEPIPE_POINT")) is not None:
        values = accessors.floats(document, point, "SCALAR", count=count)[:, 0]
        # glTF has no integers of 32 bits for attributes, so numbers are floats, which programs that compress may round
        if values.min() < 0.0 or values.max() > _LARGEST_NUMBER or np.any(values != np.floor(values)):
            document.warn(document.root, "_FACEPIPE_POINT with numbers other than whole ones from 0 to 2^24: left out")
        else:
            numbers = values.astype(np.int64)
    targets = []
    for target in primitive.get_or("targets", []).items():
        moved, turned = target.get("POSITION"), target.get("NORMAL")
        for name in target.member_names():
            if name not in ("POSITION", "NORMAL", "TANGENT", *TARGET_NOTES):
                document.warn(target, f"morphs of {ascii(name)[:40]} are left out")
        offsets = _STILL if moved is None else accessors.deltas(document, moved, count)
        normal_offsets = None if turned is None else accessors.deltas(document, turned, count)
        targets.append(Target(positions=offsets, normals=normal_offsets))
    return Vertices(
        positions=positions,
        normals=normals,
        uvs=uvs,
        colors=colors,
        joints=joints,
        weights=weights,
        point_numbers=numbers,
        targets=tuple(targets),
    )


def _join(document: Document, value: Value, read: list[Vertices]) -> Vertices:
    """The vertices of all primitives as one; what only some primitives have is completed or left out."""
    if len(read) == 1:
        return read[0]
    # glTF 2.0 wants as many targets in each primitive; where some have fewer, Blender and three.js leave these still
    most = max(len(one.targets) for one in read)
    unmoved = Target(positions=_STILL, normals=None)
    targeted = [(*one.targets, *[unmoved] * (most - len(one.targets))) for one in read]
    starts = np.cumsum([0, *(len(one.positions) for one in read[:-1])]).tolist()
    width = max(0 if one.joints is None else one.joints.shape[1] for one in read)
    normals = _join_optional(document, value, "NORMAL", [one.normals for one in read])
    uvs = {}
    for number in sorted({number for one in read for number in one.uvs}):
        if any(number not in one.uvs for one in read):
            document.warn(value, f"only some primitives have TEXCOORD_{number}: it is 0 on the others")
        zeros = [np.zeros((len(one.positions), 2), np.float32) for one in read]
        uvs[number] = np.concatenate([one.uvs.get(number, zero) for one, zero in zip(read, zeros, strict=True)])
    targets = []
    for i in range(most):
        turned = [own[i].normals for own in targeted]
        targets.append(
            Target(
                positions=_join_deltas([own[i].positions for own in targeted], starts),
                normals=_join_deltas([one or _STILL for one in turned], starts) if any(turned) else None,
            )
        )
    return Vertices(
        positions=np.concatenate([one.positions for one in read]),
        normals=normals,
        uvs=uvs,
        colors=_join_optional(document, value, "COLOR_0", [one.colors for one in read]),
        joints=None if width == 0 else np.concatenate([_widened(one.joints, width) for one in read]),
        weights=None if width == 0 else np.concatenate([_widened(one.weights, width) for one in read]),
        point_numbers=_join_optional(document, value, "_FACEPIPE_POINT", [one.point_numbers for one in read]),
        targets=tuple(targets),
    )


def _influences(document: Document, primitive: Value, attributes: Value, count: int) -> tuple[IntArray, FloatArray]:
    joints, weights = [], []
    for number in range(_MAX_SETS):
        joint, weight = attributes.get(f"JOINTS_{number}"), attributes.get(f"WEIGHTS_{number}")
        if (joint is None) != (weight is None):
            raise attributes.error(f"only one of JOINTS_{number} and WEIGHTS_{number}, expected both or none")
        if joint is None or weight is None:
            break
        joints.append(accessors.integers(document, joint, "VEC4", count=count).astype(np.int64))
        weights.append(accessors.floats(document, weight, "VEC4", count=count))
        if weights[-1].min() < 0.0:
            raise weight.error(f"a weight of {weights[-1].min():g}, expected 0 or more")
    if not joints:
        raise primitive.error("no JOINTS_0 and WEIGHTS_0, but its node has a skin")
    return np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)


def _join_optional(
    document: Document, value: Value, name: str, arrays: Sequence[npt.NDArray[Any] | None]
) -> npt.NDArray[Any] | None:
    present = [array for array in arrays if array is not None]
    if len(present) == len(arrays):
        return np.concatenate(present)
    if present:
        document.warn(value, f"only some primitives have {name}: left out")
    return None


def _widened(array: npt.NDArray[Any] | None, width: int) -> npt.NDArray[Any]:
    if array is None:
        raise AssertionError("skin weights are read on all primitives or none")
    return np.pad(array, ((0, 0), (0, width - array.shape[1])))


def _join_deltas(parts: list[Deltas], starts: list[int]) -> Deltas:
    return Deltas(
        np.concatenate([one.indices + start for one, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.values for part in parts]),
    )


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """A glTF mesh: vertices, and triangles with their materials (-1: none)."""

    value: Value
    vertices: Vertices
    triangles: IntArray  # (t, 3) vertex indices
    materials: IntArray  # (t,) by number, as of `variants`
    variants: Variants


def read_geometry(document: Document, value: Value, skinned: bool, variants: Variants) -> Geometry | None:
    """The triangles of a mesh; None where it has none. Points and lines are left out with a warning.

    :raises InputError: accessors that don't fit each other, indices out of range, target counts that differ
    """
    pools: dict[tuple[tuple[str, int], ...], tuple[int, int]] = {}  # vertices that primitives share are read once
    read: list[Vertices] = []
    triangles: list[IntArray] = []
    materials: list[IntArray] = []
    total = 0
    for primitive in value.require("primitives").items():
        number = primitive.get_or("mode", 4).integer()
        if number >= len(_MODES):
            raise primitive.error(f"mode {number}, expected 0 to 6")
        if number < 4:
            document.warn(primitive, f"{_MODES[number]} are left out, only triangles are read")
            continue
        shown = variants.number(primitive)
        primitive = unpacked(document, primitive)
        number = primitive.get_or("mode", 4).integer()
        # a key of the vertices that a primitive uses: its attributes and those of its targets
        sets = [primitive.require("attributes"), *primitive.get_or("targets", []).items()]
        key = tuple(
            (f"{i}{name}", document.index("accessors", attributes.require(name)))
            for i, attributes in enumerate(sets)
            for name in sorted({*attributes.member_names()} - {*TARGET_NOTES})
        )
        if key not in pools:
            read.append(_read_vertices(document, primitive, skinned))
            pools[key] = (total, len(read[-1].positions))
            total += pools[key][1]
        first, count = pools[key]
        corners = _triangles(document, primitive, number, count)
        triangles.append(corners + first)
        materials.append(np.full(len(corners), shown, np.int64))
    if sum(map(len, triangles)) == 0:
        return None
    if any(primitive.extension(DRACO) is not None for primitive in value.require("primitives").items()):
        _note_gaps(document, value, [one.positions for one in read])
    return Geometry(
        value=value,
        vertices=_join(document, value, read),
        triangles=np.concatenate(triangles),
        materials=np.concatenate(materials),
        variants=variants,
    )


def _note_gaps(document: Document, value: Value, positions: list[FloatArray]) -> None:
    """Warn of primitives that meet nowhere, but nearly: Draco rounds each by its own box, to 11 bits and more."""

    def shared(of_each: list[FloatArray]) -> int:
        rows = np.concatenate([np.unique(one, axis=0) for one in of_each])
        return len(rows) - len(np.unique(rows, axis=0))

    step = max(float(np.ptp(one, axis=0).max()) for one in positions) / _FEWEST_STEPS
    if step > 0.0 and not shared(positions) and shared([np.round(one / step) for one in positions]):
        document.warn(value, "Draco has rounded its primitives apart: where they meet, vertices are not joined")


def _triangles(document: Document, primitive: Value, mode: int, count: int) -> IntArray:
    reference = primitive.get("indices")
    if reference is None:
        document.budget.spend(8 * count, primitive.error)
        corners = np.arange(count)
    else:
        corners = accessors.integers(document, reference, "SCALAR")[:, 0].astype(np.int64)
        if corners.max() >= count:
            raise reference.error(f"vertex {int(corners.max())} of {count}")
    if mode == 4:
        if len(corners) % 3:
            raise primitive.error(f"{len(corners)} corners, expected triangles of 3")
        return np.asarray(corners.reshape(-1, 3))
    if len(corners) < 3:
        raise primitive.error(f"{len(corners)} corners, expected at least 3")
    if mode == 6:
        return np.stack([corners[1:-1], corners[2:], np.broadcast_to(corners[0], len(corners) - 2)], axis=1)
    odd = np.arange(len(corners) - 2) % 2  # every other triangle of a strip turns round
    steps = np.arange(len(corners) - 2)
    strip = np.stack([corners[steps], corners[steps + 1 + odd], corners[steps + 2 - odd]], axis=1)
    a, b, c = strip.T
    return np.asarray(strip[np.asarray((a != b) & (b != c) & (c != a))])  # strips jump by triangles without area
