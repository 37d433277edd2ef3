"""From the vertices of a glTF mesh to a mesh of points with face-varying UVs and normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.polygons import distinct_rows
from facepipe.parts import Landmarks, MaterialFaces, Mesh, Skin, UvSet
from facepipe_gltf.read import morphs
from facepipe_gltf.read import morphs as welds
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.morphs import Weld
from facepipe_gltf.read.primitives import Geometry, Vertices
from facepipe_gltf.read.values import Names, Value


def _landmarks(document: Document, geometry: Geometry, weld: Weld) -> dict[str, Landmarks]:
    """Landmarks by scheme."""
    ours, place = _ours(document, geometry, weld)
    listed = None if ours is None else ours.get("landmarks")
    if listed is None:
        return {}
    landmarks = {}
    for scheme in listed.member_names():
        try:
            entry = listed.require(scheme)
            points = [place[item.integer()] for item in entry.require("points").items()]
            names = tuple(item.text() for item in entry.require("names").items())
            if names and len(names) != len(points):
                raise entry.error(f"{len(names)} names, expected {len(points)}")
            landmarks[scheme] = Landmarks(indices=np.array(points, np.int32), names=names)
        except (InputError, KeyError) as error:
            _warn(document, listed, error)
    return landmarks


def _anchor(document: Document, geometry: Geometry, weld: Weld) -> int | None:
    """The anchor; None where there is none."""
    ours, place = _ours(document, geometry, weld)
    value = None if ours is None else ours.get("anchor")
    if value is None:
        return None
    try:
        return place[value.integer()]
    except (InputError, KeyError) as error:
        _warn(document, value, error)
        return None


def _warn(document: Document, value: Value, error: InputError | KeyError) -> None:
    if isinstance(error, InputError):
        document.warn(error.where, f"{error.what}: left out")
    else:
        document.warn(value, f"point {error.args[0]} is in no triangle: left out")


def _ours(document: Document, geometry: Geometry, weld: Weld) -> tuple[Value | None, dict[int, int]]:
    """Our exporter's extras of the mesh, and the point of each of its point numbers."""
    ours, numbers = geometry.value.extras().get("facepipe"), geometry.vertices.point_numbers
    if ours is None or not isinstance(ours.data, dict):
        return None, {}
    if numbers is None:
        document.warn(ours, "no _FACEPIPE_POINT in the file any more: landmarks and anchor are left out")
        return None, {}
    return ours, dict(zip(numbers[weld.vertices].tolist(), range(len(weld.vertices)), strict=True))


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
    welded = _numbered(geometry) if recorded else _weld(document, geometry, weld)
    corners, kept = _faces(document, geometry, welded)
    points = welded.points[corners].ravel()
    # the material by its number; -1 is glTF's default one, or none where display colours are to show
    shown: dict[int, str | None] = dict(enumerate(materials[:-1]))
    shown[-1] = materials[-1]
    if geometry.vertices.colors is not None and not recorded:
        shown[-1] = None
        if (geometry.materials < 0).any():
            document.warn(geometry.value, "vertex colours without a material: kept as display colours, not metallic")
        tinted = [number for number in np.unique(geometry.materials).tolist() if number >= 0]
        if not all(_is_white(document, number) for number in tinted):
            document.warn(geometry.value, "vertex colours tint a material: exports leave them out, USD shows none")
    # of triangles that are kept: a material of left out ones alone would make a subset without faces
    bound = [shown[number] for number in np.unique(geometry.materials[kept]).tolist()]
    return Mesh(
        name="mesh",
        points=vertices.positions[welded.vertices],
        face_vertex_counts=np.full(len(corners), 3, np.int32),
        face_vertex_indices=points.astype(np.int32),
        normals=_normals(vertices, welded, corners),
        uv_sets=tuple(_uv_set(number, uvs, welded, corners) for number, uvs in sorted(vertices.uvs.items())),
        colors=_colors(document, geometry, welded),
        skin=None if slots is None else _skin(document, geometry, welded, slots),
        blendshapes=morphs.blendshapes(document, geometry, welded, names),
        landmarks={} if recorded else _landmarks(document, geometry, welded),
        anchor=None if recorded else _anchor(document, geometry, welded),
        material=bound[0] if len(bound) == 1 else None,
        material_faces=_material_faces(geometry.materials[kept], shown) if len(bound) > 1 else (),
    )


def uv_name(number: int) -> str:
    """The name of the UV set TEXCOORD_<number>."""
    return "st" if number == 0 else f"st{number}"


def _numbered(geometry: Geometry) -> Weld:
    numbers = geometry.vertices.point_numbers
    welded = None if numbers is None else welds.by_number(geometry, numbers)
    if welded is None:
        raise geometry.value.error("its _FACEPIPE_POINT is gone or joins vertices that lie apart")
    return welded


def _weld(document: Document, geometry: Geometry, weld: bool) -> Weld:
    vertices = geometry.vertices
    numbers = vertices.point_numbers
    # by number before value: points that lie on each other, as those of closed lips do, are two
    if numbers is not None and weld:
        welded = welds.by_number(geometry, numbers)
        if welded is not None:
            missing = int(numbers.max()) + 1 - len(welded.vertices)
            if missing:
                document.warn(geometry.value, f"{missing} points are in no triangle: left out, numbers closed up")
            return welded
        document.warn(
            geometry.value, "_FACEPIPE_POINT joins vertices that lie apart: equal positions are welded instead"
        )
    if not weld:
        return welds.none(vertices)
    welded = welds.by_value(geometry)
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


def _is_white(document: Document, material: int) -> bool:
    """Whether a material has no colour but vertex colours."""
    surface = document.entries("materials")[material].get_or("pbrMetallicRoughness", {})
    plain = surface.get_or("baseColorFactor", [1.0] * 4).numbers(4)[:3] == (1.0, 1.0, 1.0)
    return plain and surface.get("baseColorTexture") is None


def _material_faces(numbers: IntArray, materials: Mapping[int, str | None]) -> tuple[MaterialFaces, ...]:
    groups = [(materials[number], np.flatnonzero(numbers == number)) for number in np.unique(numbers).tolist()]
    return tuple(
        MaterialFaces(material=name, faces=faces.astype(np.int32)) for name, faces in groups if name is not None
    )
