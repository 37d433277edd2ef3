"""Morph targets as blendshapes, and extra targets back to the inbetweens they came from.

Our exporter writes an inbetween as one more target ``<shape>_<inbetween>`` (offsets from the neutral, as in USD) and
says so in ``mesh.extras.facepipe.inbetweens``: ``{"<target>": {"shape": "<shape>", "weight": 0.5}}``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.names import identifier
from facepipe.geometry.polygons import distinct_rows
from facepipe.parts import Blendshape, Inbetween
from facepipe_gltf.read.accessors import Deltas
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.primitives import Geometry, Target, Vertices
from facepipe_gltf.read.values import Names, Value


@dataclass(frozen=True)
class Weld:
    """The point of every vertex (n,), -1 for vertices left out, and a vertex of every point (p,)."""

    points: IntArray
    vertices: IntArray

    @cached_property
    def first(self) -> IntArray:
        """(n,) the point of every vertex that stands for one, else -1."""
        first = np.full(len(self.points), -1, np.int64)
        first[self.vertices] = np.arange(len(self.vertices))
        return first

    @cached_property
    def counts(self) -> IntArray:
        """(p,) vertices of every point."""
        return np.bincount(self.points[self.points >= 0], minlength=len(self.vertices))


def none(vertices: Vertices) -> Weld:
    """Every vertex its own point."""
    own = np.arange(len(vertices.positions))
    return Weld(own, own)


def by_number(geometry: Geometry, numbers: IntArray) -> Weld | None:
    """Points in the order of `numbers` (n,), gaps closed; None where vertices of one number lie apart."""
    used = _used(geometry)
    _, first, inverse = np.unique(numbers[used], return_index=True, return_inverse=True)
    positions = geometry.vertices.positions[used]
    if np.any(positions != positions[first][inverse]):
        return None
    return _placed(len(geometry.vertices.positions), used, first, inverse)


def by_value(geometry: Geometry) -> Weld:
    """One point for vertices equal in position, skin weights and morph deltas, in order of first appearance.

    Vertices that no triangle uses are left out.
    """
    used = _used(geometry)
    vertices = geometry.vertices
    columns = [_bits(vertices.positions[used])]
    if vertices.joints is not None and vertices.weights is not None:
        columns += [vertices.joints[used].astype(np.uint32), _bits(vertices.weights[used])]
    first, inverse = distinct_rows(np.concatenate(columns, axis=1))
    weld = _placed(len(geometry.vertices.positions), used, first, inverse)
    scratch = np.zeros_like(vertices.positions)
    for target in vertices.targets:
        weld = _refine(weld, target, scratch)
    return weld


def _used(geometry: Geometry) -> IntArray:
    mask = np.zeros(len(geometry.vertices.positions), bool)
    mask[geometry.triangles.ravel()] = True
    return np.flatnonzero(mask)


def _placed(count: int, used: IntArray, first: IntArray, inverse: IntArray) -> Weld:
    points = np.full(count, -1, np.int64)
    points[used] = inverse
    return Weld(points, used[first])


def _refine(weld: Weld, target: Target, scratch: FloatArray) -> Weld:
    """Split points whose vertices move apart in `target`; `scratch` (n, 3) is zero before and after."""
    shared = np.flatnonzero((weld.points >= 0) & (weld.first < 0))
    if not len(shared) or not len(target.positions.indices):
        return weld
    scratch[target.positions.indices] = target.positions.values
    apart = np.any(scratch[shared] != scratch[weld.vertices[weld.points[shared]]], axis=1)
    refined = weld
    if apart.any():
        used = np.flatnonzero(weld.points >= 0)
        rows = np.concatenate([weld.points[used, None].astype(np.uint32), _bits(scratch[used])], axis=1)
        first, inverse = distinct_rows(rows)
        refined = _placed(len(weld.points), used, first, inverse)
    scratch[target.positions.indices] = 0.0
    return refined


def _bits(values: FloatArray) -> IntArray:
    """float32 values as integers that are equal where the values are (-0 is 0)."""
    return np.ascontiguousarray(values + np.float32(0.0), np.float32).view(np.uint32)


@dataclass(frozen=True)
class Role:
    """What a target is: the shape `shape` itself (weight 1) or an inbetween of it."""

    shape: str
    weight: float = 1.0
    inbetween: str = ""
    label: str | None = None  # the target's own name, where the shape's had to be another


def roles(document: Document, mesh: Value, count: int, names: Names) -> tuple[Role, ...]:
    """The role of each of a mesh's `count` targets."""
    originals = _target_names(document, mesh, count)
    folded = _inbetweens(document, mesh, originals)
    seen: Counter[str] = Counter()
    by_number: dict[int, Role] = {}
    shapes: dict[str, str] = {}
    for number, original in enumerate(originals):
        if number in folded:
            continue
        base = original or f"target_{number}"
        shape = names.same(base, seen[base])
        seen[base] += 1
        shapes.setdefault(original, shape)
        by_number[number] = Role(shape, label=original if original != shape else None)
    inbetweens: dict[str, Names] = {}
    # after all shapes: an inbetween may stand before the shape that it is of
    for number, (original, weight) in folded.items():
        stem = originals[number].removeprefix(f"{original}_")
        inbetween_names = inbetweens.setdefault(original, Names())
        by_number[number] = Role(shapes[original], weight, inbetween_names.new(identifier(stem, "inbetween")))
    return tuple(by_number[number] for number in range(count))


def blendshapes(document: Document, geometry: Geometry, weld: Weld, names: Names) -> tuple[Blendshape, ...]:
    """The blendshapes of a mesh, in the order of its targets, on welded points."""
    targets = geometry.vertices.targets
    if not targets:
        return ()
    if any(weight.number() != 0.0 for weight in geometry.value.get_or("weights", []).items()):
        document.warn(geometry.value, "default morph weights are left out: the neutral has all shapes at 0")
    by_shape: dict[str, list[tuple[Role, Target]]] = {}
    for role, target in zip(roles(document, geometry.value, len(targets), names), targets, strict=True):
        by_shape.setdefault(role.shape, []).append((role, target))
    return tuple(_blendshape(document, geometry, weld, shape, sculpts) for shape, sculpts in by_shape.items())


def _blendshape(
    document: Document, geometry: Geometry, weld: Weld, name: str, sculpts: list[tuple[Role, Target]]
) -> Blendshape:
    moved = {role: _on_points(weld, target.positions) for role, target in sculpts}
    turned = {
        role: _mean_on_points(document, geometry, weld, target.normals)
        for role, target in sculpts
        if target.normals is not None and geometry.vertices.normals is not None
    }
    every = [*moved.values(), *turned.values()]
    # a shape and its inbetweens share one list of pointIndices in USD: the union of what all move
    points = np.unique(np.concatenate([deltas.indices for deltas in every]))
    main = next(role for role in moved if not role.inbetween)
    return Blendshape(
        name=name,
        point_indices=points.astype(np.int32),
        offsets=_rows(points, moved[main]),
        normal_offsets=_rows(points, turned[main]) if main in turned else None,
        inbetweens=tuple(
            Inbetween(
                name=role.inbetween,
                weight=role.weight,
                offsets=_rows(points, moved[role]),
                normal_offsets=_rows(points, turned[role]) if role in turned else None,
            )
            for role in sorted(moved, key=lambda role: role.weight)
            if role.inbetween
        ),
        label=main.label,
    )


def _on_points(weld: Weld, deltas: Deltas) -> Deltas:
    """Deltas of points, from the vertex that stands for each."""
    points = weld.first[deltas.indices]
    kept = points >= 0
    order = np.argsort(points[kept])
    return Deltas(points[kept][order], deltas.values[kept][order])


def _mean_on_points(document: Document, geometry: Geometry, weld: Weld, deltas: Deltas) -> Deltas:
    """Deltas of points, the mean of their vertices, as a point holds one normal offset."""
    points = weld.points[deltas.indices]
    shown = points >= 0
    if not shown.any():
        return Deltas(np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
    unique, inverse, counts = np.unique(points[shown], return_inverse=True, return_counts=True)
    values = deltas.values[shown]
    sums = np.stack([np.bincount(inverse, values[:, axis]) for axis in range(3)], axis=1)
    means = (sums / weld.counts[unique][:, None]).astype(np.float32)
    if np.any(counts != weld.counts[unique]) or np.abs(values - means[inverse]).max() > 1e-4:
        document.warn(geometry.value, "normal offsets differ at seams: their mean is kept")
    return Deltas(unique, means)


def _rows(points: IntArray, deltas: Deltas) -> FloatArray:
    rows = np.zeros((len(points), 3), np.float32)
    rows[np.searchsorted(points, deltas.indices)] = deltas.values
    return rows


def _target_names(document: Document, mesh: Value, count: int) -> list[str]:
    primitives = mesh.require("primitives").items()
    for value in (mesh, *primitives):
        names = value.extras().get("targetNames")
        if names is None:
            continue
        listed = names.data
        if isinstance(listed, list) and len(listed) == count and all(isinstance(name, str) for name in listed):
            nameless = sum(not name for name in listed)
            if nameless:
                document.warn(names, f"{nameless} of {count} names are empty: called target_<number>")
            return [name.name() for name in names.items()]
        document.warn(names, f"is not a list of {count} names: targets are numbered instead")
        break
    else:
        document.warn(mesh, f"its {count} morph targets have no names: called target_<number>")
    return [f"target_{i}" for i in range(count)]


def _inbetweens(document: Document, mesh: Value, originals: list[str]) -> dict[int, tuple[str, float]]:
    """Target number -> shape and weight of every target that is an inbetween."""
    ours = mesh.extras().get("facepipe")
    listed = ours.get("inbetweens") if ours is not None else None
    if listed is None:
        return {}
    inbetweens: dict[int, tuple[str, float]] = {}
    for target in listed.member_names():
        entry = listed.require(target)
        shape, weight = entry.require("shape").text(), entry.require("weight").number()
        known = target in originals and shape in originals and target != shape and shape not in listed.member_names()
        if not known or weight in (0.0, 1.0) or (shape, weight) in inbetweens.values():
            document.warn(entry, "names no target and shape with a weight of their own: it stays a shape")
            continue
        inbetweens[originals.index(target)] = (shape, weight)
    return inbetweens
