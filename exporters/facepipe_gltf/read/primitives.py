"""All primitives of one glTF mesh as one list of vertices and one of triangles.

Source: glTF 2.0 sections 3.7.2 (geometry, primitive modes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe_gltf.read import accessors
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.values import Value, members
from facepipe_gltf.read.vertices import Vertices, join, read_vertices

_MODES = ("points", "lines", "line loop", "line strip", "triangles", "triangle strip", "triangle fan")


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """A glTF mesh: vertices, and triangles with their materials (-1: none)."""

    value: Value
    vertices: Vertices
    triangles: IntArray  # (t, 3) vertex indices
    materials: IntArray  # (t,)


def read_geometry(document: Document, value: Value, skinned: bool) -> Geometry | None:
    """The triangles of a mesh; None where it has none. Points and lines are left out with a warning.

    :raises InputError: accessors that don't fit each other, indices out of range, target counts that differ
    """
    pools: dict[tuple[tuple[str, int], ...], tuple[int, int]] = {}  # vertices that primitives share are read once
    read: list[Vertices] = []
    triangles: list[IntArray] = []
    materials: list[IntArray] = []
    total = 0
    for primitive in value.require("primitives").items():
        mode = primitive.get("mode")
        number = 4 if mode is None else mode.integer()
        if number >= len(_MODES):
            raise primitive.error(f"mode {number}, expected 0 to 6")
        if number < 4:
            document.warn(primitive, f"{_MODES[number]} are left out, only triangles are read")
            continue
        key = _pool_key(document, primitive)
        if key not in pools:
            read.append(read_vertices(document, primitive, skinned))
            pools[key] = (total, len(read[-1].positions))
            total += pools[key][1]
        first, count = pools[key]
        corners = _triangles(document, primitive, number, count)
        triangles.append(corners + first)
        materials.append(np.full(len(corners), _material(document, primitive), np.int64))
    if sum(map(len, triangles)) == 0:
        return None
    return Geometry(
        value=value,
        vertices=join(document, value, read),
        triangles=np.concatenate(triangles),
        materials=np.concatenate(materials),
    )


def _pool_key(document: Document, primitive: Value) -> tuple[tuple[str, int], ...]:
    """What says which vertices a primitive uses: its attributes and those of its targets."""
    sets = [primitive.require("attributes"), *members(primitive.get("targets"))]
    return tuple(
        (f"{i}{name}", document.index("accessors", attributes.require(name)))
        for i, attributes in enumerate(sets)
        for name in sorted(attributes.member_names())
    )


def _material(document: Document, primitive: Value) -> int:
    material = primitive.get("material")
    return -1 if material is None else document.index("materials", material)


def _triangles(document: Document, primitive: Value, mode: int, count: int) -> IntArray:
    reference = primitive.get("indices")
    if reference is None:
        document.budget.spend(8 * count, primitive)
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
    return np.asarray(strip[_distinct(strip)])  # strips jump by triangles without area


def _distinct(triangles: IntArray) -> IntArray:
    a, b, c = triangles.T
    return np.asarray((a != b) & (b != c) & (c != a))
