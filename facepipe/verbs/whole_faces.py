"""Whole points of a face: those of all its meshes one after another, in world space, millimetres, Y up."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unknown
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import mesh_spaces

MILLIMETRES = FaceParts(name="millimetres", meters_per_unit=0.001, up_axis="Y")  # the space of whole points

NEXT_MM = 0.1  # to each other's: points that lie next to one another
_SINGULAR = 1e-12  # of the product of the column lengths
_Z_TO_Y = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def world_to_world(meters_per_unit: float, up_axis: str, base: FaceParts) -> FloatArray:
    """(4, 4) from the world of a stage with these units and up axis to the world of the stage of `base`."""
    turn = np.eye(4)
    if up_axis != base.up_axis:
        turn = _Z_TO_Y if up_axis == "Z" else _Z_TO_Y.T
    scale = meters_per_unit / base.meters_per_unit
    return np.asarray(np.diag([scale, scale, scale, 1.0]) @ turn)


def in_order(base: FaceParts, base_name: str, other: FaceParts, name: str) -> FaceParts:
    """`other` with the meshes of `base`, in its order.

    :raises TopologyError: a mesh that `other` lacks, or the first difference of one
    """
    named = {mesh.name: mesh for mesh in other.meshes}
    for mesh in base.meshes:
        if mesh.name not in named:
            found = ", ".join(named) or "none"
            raise TopologyError(name, f"no mesh '{mesh.name}', expected the meshes of {base_name}; it has {found}")
        check_same_faces(f"{name} -> {mesh.name}", named[mesh.name], mesh, base_name)
    return replace(other, meshes=tuple(named[mesh.name] for mesh in base.meshes))


def check_same_faces(where: str, mesh: Mesh, base: Mesh, base_name: str) -> None:
    """:raises TopologyError: the first count or face in which `mesh` is not like `base`"""
    for what, actual, expected in (
        ("points", len(mesh.points), len(base.points)),
        ("faces", len(mesh.face_vertex_counts), len(base.face_vertex_counts)),
    ):
        if actual != expected:
            raise TopologyError(where, f"{actual:,} {what}, expected {expected:,} as in {base_name}")
    counts = np.flatnonzero(mesh.face_vertex_counts != base.face_vertex_counts)
    if len(counts):
        face = counts[0]
        actual, expected = int(mesh.face_vertex_counts[face]), int(base.face_vertex_counts[face])
        raise TopologyError(where, f"face {face} has {actual} corners, expected {expected} as in {base_name}")
    corners = np.flatnonzero(mesh.face_vertex_indices != base.face_vertex_indices)
    if len(corners):
        corner = corners[0]
        face = int(np.searchsorted(np.cumsum(base.face_vertex_counts), corner, side="right"))
        actual, expected = int(mesh.face_vertex_indices[corner]), int(base.face_vertex_indices[corner])
        raise TopologyError(where, f"face {face} uses point {actual}, expected point {expected} as in {base_name}")


def check_spaces(name: str, parts: FaceParts) -> None:
    """:raises TopologyError: a mesh or skeleton space that is flat, from which there is no way back"""
    spaces = zip([mesh.name for mesh in parts.meshes], mesh_spaces(parts), strict=True)
    for what, space in [(parts.skeleton.name, parts.skeleton.transform), *spaces]:
        check_invertible(f"{name} -> {what}", "transform", space)


def check_invertible(where: str, what: str, matrix: FloatArray) -> None:
    """:raises TopologyError: a (4, 4) matrix that is flat"""
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    if not abs(np.linalg.det(linear)) > _SINGULAR * np.linalg.norm(linear, axis=0).prod():
        raise TopologyError(where, f"singular {what}, expected an invertible one")


@dataclass(frozen=True)
class Match:
    """Points of the face (k,) and of the other meshes (k,), each over all meshes one after another."""

    rows: IntArray
    others: IntArray
    notes: tuple[str, ...] = ()


def match_meshes(
    parts: FaceParts, others: Sequence[Mesh], where: str, only: str = "", *, triangles: bool = False
) -> Match:
    """Meshes by name; a single mesh of another name is the only one of as many points, or all in stage order.

    :param only: the mesh of the face that the single other mesh is
    :param triangles: the other meshes are triangulated, and lack points that are in no face, but for those of our own
        files, which come back as they were
    :raises InputError: a mesh that could be several, or no mesh called `only`
    :raises TopologyError: the first difference of two meshes
    """
    pairs = _pairs(parts.meshes, others, where, only)
    starts, other_starts = _starts(parts.meshes), _starts(others)
    if pairs is None:
        corners = [mesh.face_vertex_indices for mesh in parts.meshes]
        whole = Mesh(
            name="all",
            points=np.concatenate([mesh.points for mesh in parts.meshes]),
            face_vertex_counts=np.concatenate([mesh.face_vertex_counts for mesh in parts.meshes]),
            face_vertex_indices=np.concatenate([own + start for own, start in zip(corners, starts, strict=False)]),
        )
        check_same_faces(f"{where} -> {others[0].name}", others[0], whole, parts.name)
        numbers = np.arange(len(whole.points))
        return Match(numbers, numbers)
    rows, other_rows = [], []
    for number, other in pairs:
        mesh, trail = parts.meshes[number], f"{where} -> {others[other].name}"
        used = np.arange(len(mesh.points))
        if triangles and (np.asarray(others[other].face_vertex_counts) == 3).all():
            # a writer of triangles drops points that are in no face, but not ours
            used = np.unique(mesh.face_vertex_indices)
            if len(others[other].points) == len(mesh.points):
                used = np.arange(len(mesh.points))
            _check_triangles(trail, others[other], mesh, used, parts.name)
        else:
            check_same_faces(trail, others[other], mesh, parts.name)
        rows.append(starts[number] + used)
        other_rows.append(other_starts[other] + np.arange(len(used)))
    paired, other_paired = ({pair[end] for pair in pairs} for end in (0, 1))
    lacking = [mesh.name for number, mesh in enumerate(parts.meshes) if number not in paired]
    extra = [mesh.name for number, mesh in enumerate(others) if number not in other_paired]
    notes = [f"{where}: lacks meshes, which don't count: {', '.join(lacking)}"] if lacking else []
    notes += [f"{where}: meshes that the face lacks: {', '.join(extra)}"] if extra else []
    return Match(np.concatenate(rows), np.concatenate(other_rows), tuple(notes))


def _pairs(meshes: Sequence[Mesh], others: Sequence[Mesh], where: str, only: str) -> list[tuple[int, int]] | None:
    """Numbers of meshes and of others that belong together; None where the one other mesh is all of them."""
    names, places = [mesh.name for mesh in meshes], {mesh.name: number for number, mesh in enumerate(others)}
    if only:
        if only not in names:
            raise InputError(f"{where}:{only}", f"the face has {unknown(only, names, 'mesh')}")
        if len(others) != 1 and only not in places:
            raise InputError(f"{where}:{only}", f"{len(others)} meshes, expected a single one or one called '{only}'")
        return [(names.index(only), places.get(only, 0))]
    if len(others) == 1:
        # by name, or the only one of as many points, or all of them
        points, count, called = [len(mesh.points) for mesh in meshes], len(others[0].points), others[0].name
        if called in names and points[names.index(called)] == count:
            return [(names.index(called), 0)]
        if points.count(count) == 1:
            return [(points.index(count), 0)]
        if count == sum(points):
            return None
        if called in names or len(meshes) == 1:
            return [(names.index(called) if called in names else 0, 0)]  # whose first difference is an error
        what = f"mesh '{called}' of {count:,} points is none of {', '.join(names)}"
        raise TopologyError(where, f"{what}, expected FILE:MESH to say which")
    pairs = [(number, places[name]) for number, name in enumerate(names) if name in places]
    if not pairs:
        some = ", ".join(list(places)[:6]) or "none"
        raise TopologyError(where, f"meshes {some}, expected some of {', '.join(names)}")
    return pairs


def _starts(meshes: Sequence[Mesh]) -> IntArray:
    return np.concatenate([[0], np.cumsum([len(mesh.points) for mesh in meshes], dtype=np.int64)])


def _check_triangles(where: str, other: Mesh, mesh: Mesh, used: IntArray, name: str) -> None:
    """Check triangles against the faces that they were made of: each edge of these is one of theirs.

    :raises TopologyError: the first difference
    """
    counts = np.asarray(mesh.face_vertex_counts, dtype=np.int64)
    wanted = int(np.maximum(counts - 2, 0).sum())
    for what, count, expected in (
        ("points", len(other.points), len(used)),
        ("triangles", len(other.face_vertex_counts), wanted),
    ):
        if count != expected:
            raise TopologyError(where, f"{count:,} {what}, expected {expected:,} as in {name}")
    # by edges of the faces: these are in any triangulation, whichever diagonals a tool chose
    keys = np.unique(_edges(other.face_vertex_counts, other.face_vertex_indices, len(used)))
    edges = _edges(counts, np.searchsorted(used, mesh.face_vertex_indices), len(used))
    missing = np.flatnonzero(~np.isin(edges, keys))
    if len(missing):
        face = int(np.searchsorted(np.cumsum(counts), missing[0], side="right"))
        a, b = (int(used[end]) for end in divmod(int(edges[missing[0]]), len(used)))
        raise TopologyError(where, f"no edge between points {a} and {b}, expected it as in face {face} of {name}")


def _edges(counts: IntArray, indices: IntArray, points: int) -> IntArray:
    """(corners,) one number for the edge from each corner to the next, whichever way it is gone."""
    counts = counts[counts > 0]
    ends = np.cumsum(counts)
    following = np.arange(1, len(indices) + 1)
    following[ends - 1] = ends - counts
    a, b = np.asarray(indices, dtype=np.int64), np.asarray(indices, dtype=np.int64)[following]
    return np.minimum(a, b) * points + np.maximum(a, b)


@dataclass(frozen=True, kw_only=True)
class Topology:
    """The meshes of a face without their points, in the order of whole points."""

    names: tuple[str, ...]
    points: tuple[int, ...]  # of each mesh
    counts: tuple[IntArray, ...]  # (faces,) int32 corners of each face
    indices: tuple[IntArray, ...]  # (corners,) int32 points of a mesh

    @classmethod
    def of(cls, parts: FaceParts) -> Topology:
        """That of a face."""
        return cls(
            names=tuple(mesh.name for mesh in parts.meshes),
            points=tuple(len(mesh.points) for mesh in parts.meshes),
            counts=tuple(np.asarray(mesh.face_vertex_counts, dtype=np.int32) for mesh in parts.meshes),
            indices=tuple(np.asarray(mesh.face_vertex_indices, dtype=np.int32) for mesh in parts.meshes),
        )

    @property
    def point_count(self) -> int:
        """Whole points."""
        return sum(self.points)

    @property
    def triangles(self) -> IntArray:
        """(t, 3) whole points of the triangles of all meshes."""
        starts = np.cumsum([0, *self.points])[:-1]
        pairs = zip(starts, self.counts, self.indices, strict=True)
        return np.concatenate([start + point_triangles(counts, indices) for start, counts, indices in pairs])

    @property
    def digest(self) -> str:
        """``sha256:...`` that differs between topologies."""
        sha = hashlib.sha256(repr((self.names, self.points)).encode())
        for counts, indices in zip(self.counts, self.indices, strict=True):
            sha.update(counts.astype("<i4").tobytes() + b"|" + indices.astype("<i4").tobytes() + b"|")
        return f"sha256:{sha.hexdigest()}"

    def parts(self, points: FloatArray, name: str = "Face") -> FaceParts:
        """A face of whole points (n, 3), in millimetres, without anything else."""
        pieces = np.split(np.asarray(points), np.cumsum(self.points)[:-1])
        meshes = tuple(
            Mesh(name=mesh, points=piece, face_vertex_counts=counts, face_vertex_indices=indices)
            for mesh, piece, counts, indices in zip(self.names, pieces, self.counts, self.indices, strict=True)
        )
        return FaceParts(name=name, meters_per_unit=0.001, up_axis="Y", meshes=meshes)


@dataclass(frozen=True, kw_only=True)
class WholeFace:
    """A neutral and its expressions, in millimetres."""

    name: str
    topology: Topology
    points: FloatArray  # (n, 3)
    deltas: Mapping[str, FloatArray] = field(default_factory=dict)  # shape -> (n, 3) from the neutral
    meshes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # shape -> the meshes that have it, by name
    source: str = ""  # file name
    digest: str = ""  # of the source
    warnings: tuple[str, ...] = ()

    @property
    def content(self) -> str:
        """``sha256:...`` of the points and shapes, as float32: the same face in another file has the same."""
        sha = hashlib.sha256(self.points.astype("<f4").tobytes())
        for name in sorted(self.deltas):
            sha.update(name.encode() + self.deltas[name].astype("<f4").tobytes())
        return f"sha256:{sha.hexdigest()}"


def whole_points(parts: FaceParts) -> FloatArray:
    """(n, 3) points of all meshes in the stage's order, in world space at bind time, millimetres, Y up."""
    placed = zip(parts.meshes, to_millimetres(parts), strict=True)
    pieces = [transformed(mesh.points, to) for mesh, to in placed]
    return np.concatenate(pieces) if pieces else np.zeros((0, 3))


def whole_parts(parts: FaceParts, points: FloatArray) -> FaceParts:
    """The face with whole points (n, 3) in place of its own, in their space and without rig, ready to be drawn."""
    pieces = np.split(np.asarray(points), np.cumsum([len(mesh.points) for mesh in parts.meshes])[:-1])
    meshes = tuple(
        replace(mesh, points=own, transform=np.eye(4), normals=None, skin=None, blendshapes=())
        for mesh, own in zip(parts.meshes, pieces, strict=True)
    )
    return FaceParts(name=parts.name, meters_per_unit=0.001, up_axis="Y", meshes=meshes, materials=parts.materials)


def whole_face(
    parts: FaceParts, name: str, base: Topology | None = None, base_name: str = "the first face"
) -> WholeFace:
    """The neutral and the blendshapes of a face; of a shape, the sculpt at weight 1.

    :param base: the topology that it must have
    :raises TopologyError: no points, a flat space, or another topology, with the first difference
    """
    warnings = []
    if base is not None:
        known = in_order(base.parts(np.zeros((base.point_count, 3))), base_name, parts, name)
        extra = [mesh.name for mesh in parts.meshes if mesh.name not in base.names]
        if extra:
            warnings.append(f"{name}: meshes that {base_name} lacks are left out: {', '.join(extra)}")
        parts = known
    check_spaces(name, parts)
    points = whole_points(parts)
    if not len(points):
        raise TopologyError(name, "has no points, expected a face with meshes")
    between = sorted({shape.name for mesh in parts.meshes for shape in mesh.blendshapes if shape.inbetweens})
    if between:
        warnings.append(f"{name}: inbetweens of {', '.join(between)} are left out")
    deltas = {shape: np.zeros((len(points), 3)) for shape in parts.shapes}
    meshes: dict[str, list[str]] = {shape: [] for shape in parts.shapes}
    start = 0
    for mesh, to in zip(parts.meshes, to_millimetres(parts), strict=True):
        for blendshape in mesh.blendshapes:
            # offsets are differences of points: the translation cancels
            moved = np.asarray(blendshape.offsets, np.float64) @ to[:3, :3].T
            deltas[blendshape.name][start + blendshape.point_indices] = moved
            meshes[blendshape.name].append(mesh.name)
        start += len(mesh.points)
    return WholeFace(
        name=name,
        topology=Topology.of(parts),
        points=points,
        deltas=deltas,
        meshes={shape: tuple(dict.fromkeys(names)) for shape, names in meshes.items()},
        warnings=tuple(warnings),
    )


def to_millimetres(parts: FaceParts) -> list[FloatArray]:
    """(4, 4) from the space of each mesh."""
    world = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES) @ parts.skeleton.transform
    return [np.asarray(world @ space) for space in mesh_spaces(parts)]
