"""From the vertices of a glTF mesh to a mesh of points with face-varying UVs and normals, and its blendshapes.

Vertices become points by a `Weld`; morph targets become shapes, and extra targets the inbetweens that they came from.
Our exporter writes an inbetween as one more target ``<shape>_<inbetween>`` (offsets from the neutral, as in USD) and
says so in ``mesh.extras.facepipe.inbetweens``: ``{"<target>": {"shape": "<shape>", "weight": 0.5}}``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import identifier
from facepipe.geometry.polygons import distinct_rows
from facepipe.parts import Blendshape, Inbetween, Landmarks, MaterialFaces, Mesh, Skin, UvSet
from facepipe_gltf.read.accessors import Deltas
from facepipe_gltf.read.document import Document, Names, Value
from facepipe_gltf.read.primitives import Geometry, Target, Vertices


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


def _by_value(geometry: Geometry) -> Weld:
    """One point for vertices equal in position, skin weights and morph deltas, in order of first appearance.

    Vertices that no triangle uses are left out.
    """
    used = _used(geometry)
    vertices = geometry.vertices
    columns = [_bits(vertices.positions[used])]
    if vertices.joints is not None and vertices.weights is not None:
        columns += [vertices.joints[used].astype(np.uint32), _bits(vertices.weights[used])]
    first, inverse = distinct_rows(np.concatenate(columns, axis=1))
    weld = _placed(len(vertices.positions), used, first, inverse)
    # points whose vertices move apart in a target are split, target by target: all at once would be rows of thousands
    # of numbers; `moved` is zero before and after each
    moved = np.zeros_like(vertices.positions)
    for target in vertices.targets:
        shared = np.flatnonzero((weld.points >= 0) & (weld.first < 0))
        if not len(shared) or not len(target.positions.indices):
            continue
        moved[target.positions.indices] = target.positions.values
        if np.any(moved[shared] != moved[weld.vertices[weld.points[shared]]]):
            used = np.flatnonzero(weld.points >= 0)
            rows = np.concatenate([weld.points[used, None].astype(np.uint32), _bits(moved[used])], axis=1)
            weld = _placed(len(weld.points), used, *distinct_rows(rows))
        moved[target.positions.indices] = 0.0
    return weld


def _used(geometry: Geometry) -> IntArray:
    mask = np.zeros(len(geometry.vertices.positions), bool)
    mask[geometry.triangles.ravel()] = True
    return np.flatnonzero(mask)


def _placed(count: int, used: IntArray, first: IntArray, inverse: IntArray) -> Weld:
    points = np.full(count, -1, np.int64)
    points[used] = inverse
    return Weld(points, used[first])


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
    originals = [f"target_{i}" for i in range(count)]
    for value in (mesh, *mesh.require("primitives").items()):
        given = value.extras().get("targetNames")
        if given is None:
            continue
        listed = given.data
        if isinstance(listed, list) and len(listed) == count and all(isinstance(name, str) for name in listed):
            nameless = sum(not name for name in listed)
            if nameless:
                document.warn(given, f"{nameless} of {count} names are empty: called target_<number>")
            originals = [name.name() for name in given.items()]
        else:
            document.warn(given, f"is not a list of {count} names: targets are numbered instead")
        break
    else:
        beside = _names_beside(document, mesh.require("primitives").items(), count)
        if not beside:
            document.warn(mesh, f"its {count} morph targets have no names: called target_<number>")
        originals = beside or originals
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


def _blendshapes(document: Document, geometry: Geometry, weld: Weld, names: Names) -> tuple[Blendshape, ...]:
    """The blendshapes of a mesh, in the order of its targets, on welded points."""
    targets = geometry.vertices.targets
    if not targets:
        return ()
    by_shape: dict[str, list[tuple[Role, Target]]] = {}
    for role, target in zip(roles(document, geometry.value, len(targets), names), targets, strict=True):
        by_shape.setdefault(role.shape, []).append((role, target))
    shapes = []
    for name, sculpts in by_shape.items():
        moved: dict[Role, Deltas] = {}
        turned: dict[Role, Deltas] = {}
        for role, target in sculpts:
            # of the vertex that stands for each point: a weld has split points whose vertices move apart
            points = weld.first[target.positions.indices]
            kept = points >= 0
            order = np.argsort(points[kept])
            moved[role] = Deltas(points[kept][order], target.positions.values[kept][order])
            if target.normals is not None and geometry.vertices.normals is not None:
                turned[role] = _mean_on_points(document, geometry, weld, target.normals)
        # a shape and its inbetweens share one list of pointIndices in USD: the union of what all move
        every = np.unique(np.concatenate([deltas.indices for deltas in (*moved.values(), *turned.values())]))
        offsets = {role: _rows(every, deltas) for role, deltas in moved.items()}
        normal_offsets = {role: _rows(every, deltas) for role, deltas in turned.items()}
        main = next(role for role in moved if not role.inbetween)
        shapes.append(
            Blendshape(
                name=name,
                point_indices=every.astype(np.int32),
                offsets=offsets[main],
                normal_offsets=normal_offsets.get(main),
                inbetweens=tuple(
                    Inbetween(
                        name=role.inbetween,
                        weight=role.weight,
                        offsets=offsets[role],
                        normal_offsets=normal_offsets.get(role),
                    )
                    for role in sorted(moved, key=lambda role: role.weight)
                    if role.inbetween
                ),
                label=main.label,
            )
        )
    return tuple(shapes)


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


def _names_beside(document: Document, primitives: list[Value], count: int) -> list[str]:
    """Names of targets where exporters without `targetNames` put them; none where some lack one.

    In the target (``extras.name``, ``extra.name``, ``name``), or as the name of its accessor (FBX2glTF).
    """
    targets = next((own for one in primitives if len(own := one.get_or("targets", []).items()) == count), [])
    names = []
    for target in targets:
        beside = [target.get("extras"), target.get("extra"), target]
        position = target.get("POSITION")
        if position is not None:
            beside.append(document.entry("accessors", position))
        given = [one.get("name") for one in beside if one is not None and isinstance(one.data, dict)]
        names.append(next((one.name() for one in given if one is not None and isinstance(one.data, str)), ""))
    return names if all(names) and len({*names}) == len(names) else []


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


def _marks(document: Document, geometry: Geometry, weld: Weld) -> dict[str, Any]:
    """The mesh's landmarks and anchor, of our exporter's extras; those that don't fit are left out with a warning."""
    ours, numbers = geometry.value.extras().get("facepipe"), geometry.vertices.point_numbers
    if ours is None or not isinstance(ours.data, dict):
        return {}
    if numbers is None:
        document.warn(ours, "no _FACEPIPE_POINT in the file any more: landmarks and anchor are left out")
        return {}
    # by the file's own numbers of points: welding closes the gaps of points in no triangle
    place = dict(zip(numbers[weld.vertices].tolist(), range(len(weld.vertices)), strict=True))

    def warn(value: Value, error: InputError | KeyError) -> None:
        if isinstance(error, InputError):
            document.warn(error.where, f"{error.what}: left out")
        else:
            document.warn(value, f"point {error.args[0]} is in no triangle: left out")

    landmarks, anchor = {}, None
    listed, marked = ours.get_or("landmarks", {}), ours.get("anchor")
    for scheme in listed.member_names():
        try:
            entry = listed.require(scheme)
            points = [place[item.integer()] for item in entry.require("points").items()]
            names = tuple(item.text() for item in entry.require("names").items())
            if names and len(names) != len(points):
                raise entry.error(f"{len(names)} names, expected {len(points)}")
            landmarks[scheme] = Landmarks(indices=np.array(points, np.int32), names=names)
        except (InputError, KeyError) as error:
            warn(listed, error)
    if marked is not None:
        try:
            anchor = place[marked.integer()]
        except (InputError, KeyError) as error:
            warn(marked, error)
    return {"landmarks": landmarks, "anchor": anchor}


def build_mesh(
    document: Document,
    geometry: Geometry,
    names: Names,
    weld: bool,
    slots: IntArray | None,
    materials: Sequence[str],
    recorded: bool = False,
) -> Mesh:
    """A mesh, its name and transform still to be set.

    :param names: identifiers of shapes, shared by all meshes
    :param weld: merge vertices into points (`_FACEPIPE_POINT` decides where the file has it)
    :param slots: joint of the skeleton for every joint of the skin; None: no skin
    :param materials: names of all materials of the document
    :param recorded: the file's record has landmarks and the like, and counts on its points
    :raises InputError: no triangles, or points other than the record's
    """
    vertices = geometry.vertices
    welded = _weld(document, geometry, weld, recorded)
    corners, kept = _faces(document, geometry, welded)
    points = welded.points[corners].ravel()
    # the material by its number; -1 is glTF's default one, or none where display colours are to show
    shown: dict[int, str | None] = dict(enumerate(materials[:-1]))
    shown[-1] = materials[-1]
    if geometry.vertices.colors is not None and not recorded:
        shown[-1] = None
        if (geometry.materials < 0).any():
            document.warn(geometry.value, "vertex colours without a material: kept as display colours, not metallic")
        for number in np.unique(geometry.materials[geometry.materials >= 0]).tolist():
            surface = geometry.variants.value(number).get_or("pbrMetallicRoughness", {})
            plain = surface.get_or("baseColorFactor", [1.0] * 4).numbers(4)[:3] == (1.0, 1.0, 1.0)
            if not plain or surface.get("baseColorTexture") is not None:
                document.warn(geometry.value, "vertex colours tint a material: exports leave them out, USD shows none")
                break
    # of triangles that are kept: a material of left out ones alone would make a subset without faces
    numbers = geometry.materials[kept]
    bound = {number: shown[number] for number in np.unique(numbers).tolist()}
    return Mesh(
        name="mesh",
        points=vertices.positions[welded.vertices],
        face_vertex_counts=np.full(len(corners), 3, np.int32),
        face_vertex_indices=points.astype(np.int32),
        normals=_normals(vertices, welded, corners),
        uv_sets=tuple(_uv_set(number, uvs, welded, corners) for number, uvs in sorted(vertices.uvs.items())),
        colors=_colors(document, geometry, welded),
        skin=None if slots is None else _skin(document, geometry, welded, slots),
        blendshapes=_blendshapes(document, geometry, welded, names),
        **({} if recorded else _marks(document, geometry, welded)),
        material=next(iter(bound.values())) if len(bound) == 1 else None,
        material_faces=tuple(
            MaterialFaces(material=name, faces=np.flatnonzero(numbers == number).astype(np.int32))
            for number, name in bound.items()
            if name is not None and len(bound) > 1
        ),
    )


def uv_name(number: int) -> str:
    """The name of the UV set TEXCOORD_<number>."""
    return "st" if number == 0 else f"st{number}"


def _weld(document: Document, geometry: Geometry, weld: bool, recorded: bool) -> Weld:
    vertices = geometry.vertices
    numbers = vertices.point_numbers
    welded = None
    # by number before value: points that lie on each other, as those of closed lips do, are two
    if numbers is not None and weld:
        used = _used(geometry)
        _, first, inverse = np.unique(numbers[used], return_index=True, return_inverse=True)
        if not np.any(vertices.positions[used] != vertices.positions[used[first]][inverse]):
            welded = _placed(len(vertices.positions), used, first, inverse)
    if recorded:
        if welded is None:
            raise geometry.value.error("its _FACEPIPE_POINT is gone or joins vertices that lie apart")
        return welded
    if not weld:
        own = np.arange(len(vertices.positions))
        return Weld(own, own)
    if numbers is not None and welded is not None:
        missing = int(numbers.max()) + 1 - len(welded.vertices)
        if missing:
            document.warn(geometry.value, f"{missing} points are in no triangle: left out, numbers closed up")
        return welded
    if numbers is not None:
        document.warn(
            geometry.value, "_FACEPIPE_POINT joins vertices that lie apart: equal positions are welded instead"
        )
    welded = _by_value(geometry)
    unused = int(np.count_nonzero(welded.points < 0))
    if unused:
        document.warn(geometry.value, f"{unused} vertices are in no triangle: left out")
    return welded


def _faces(document: Document, geometry: Geometry, weld: Weld) -> tuple[IntArray, IntArray]:
    """Triangles (t, 3) of vertices that have three different points, and their numbers (t,)."""
    a, b, c = weld.points[geometry.triangles].T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    lost = len(geometry.triangles) - len(kept)
    if not len(kept):
        raise geometry.value.error("no triangle has three different points")
    if lost:
        document.warn(geometry.value, f"{lost} triangles with fewer than three different points are left out")
    return geometry.triangles[kept], kept


def _normals(vertices: Vertices, weld: Weld, corners: IntArray) -> FloatArray | None:
    """Per point where all its vertices agree, else face-varying."""
    if vertices.normals is None:
        return None
    per_point = vertices.normals[weld.vertices]
    at_corners = vertices.normals[corners.ravel()]
    if np.array_equal(at_corners, per_point[weld.points[corners.ravel()]]):
        return per_point
    return at_corners


def _uv_set(number: int, uvs: FloatArray, weld: Weld, corners: IntArray) -> UvSet:
    """Values with v up; face-varying where a point has more than one."""
    values = np.stack([uvs[:, 0], np.float32(1.0) - uvs[:, 1]], axis=1)
    used = corners.ravel()
    per_point = values[weld.vertices]
    if np.array_equal(values[used], per_point[weld.points[used]]):
        return UvSet(name=uv_name(number), values=per_point)
    keys = np.concatenate([weld.points[used, None].astype(np.uint32), values[used].view(np.uint32)], axis=1)
    first, inverse = distinct_rows(keys)
    return UvSet(name=uv_name(number), values=values[used[first]], indices=inverse.astype(np.int32))


def _colors(document: Document, geometry: Geometry, weld: Weld) -> FloatArray | None:
    colors = geometry.vertices.colors
    if colors is None:
        return None
    shown = np.flatnonzero(weld.points >= 0)
    if np.any(colors[shown] != colors[weld.vertices][weld.points[shown]]):
        document.warn(geometry.value, "vertex colours differ at seams: one colour of each point is kept")
    return colors[weld.vertices]


def _skin(document: Document, geometry: Geometry, weld: Weld, slots: IntArray) -> Skin:
    joints, weights = geometry.vertices.joints, geometry.vertices.weights
    if joints is None or weights is None:
        raise AssertionError("a skinned mesh has joints and weights")
    joints, weights = joints[weld.vertices], weights[weld.vertices]
    # the joint of a weight of 0 means nothing: files have there what is out of range
    joints = np.where(weights > 0.0, joints, 0)
    if joints.max() >= len(slots):
        raise geometry.value.error(f"joint {int(joints.max())} of a skin with {len(slots)}")
    sums = weights.sum(axis=1, dtype=np.float64)
    lost = sums <= 0.0
    if lost.any():
        document.warn(geometry.value, f"{int(lost.sum())} points without a weight follow the skin's first joint")
        weights[lost, 0], sums[lost] = 1.0, 1.0
    error = float(np.abs(sums - 1.0).max())
    if error > 1e-6:
        document.warn(geometry.value, f"weights sum to 1 only within {error:.2g}: renormalised")
        weights = (weights / sums[:, None]).astype(np.float32)
    used = max(1, int(np.flatnonzero(np.any(weights > 0.0, axis=0)).max(initial=0)) + 1)
    indices = np.where(weights > 0.0, slots[joints], 0)[:, :used]
    return Skin(joint_indices=indices.astype(np.int32), joint_weights=weights[:, :used])
