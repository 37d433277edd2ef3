"""Whole points of a face: those of all its meshes one after another, in world space, millimetres, Y up."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import mesh_spaces
from facepipe.verbs.same_topology import MILLIMETRES, check_spaces, in_order, world_to_world


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
    shapes = parts.shapes
    return WholeFace(
        name=name,
        topology=Topology.of(parts),
        points=points,
        deltas={shape: _delta(parts, shape) for shape in shapes},
        meshes={shape: _having(parts, shape) for shape in shapes},
        warnings=tuple(warnings),
    )


def _delta(parts: FaceParts, shape: str) -> FloatArray:
    ends = np.cumsum([len(mesh.points) for mesh in parts.meshes])
    delta = np.zeros((int(ends[-1]), 3))
    for mesh, end, to in zip(parts.meshes, ends, to_millimetres(parts), strict=True):
        for blendshape in mesh.blendshapes:
            if blendshape.name == shape:
                start = int(end) - len(mesh.points)
                delta[start + blendshape.point_indices] = np.asarray(blendshape.offsets, np.float64) @ to[:3, :3].T
    return delta


def _having(parts: FaceParts, shape: str) -> tuple[str, ...]:
    return tuple(mesh.name for mesh in parts.meshes if any(blendshape.name == shape for blendshape in mesh.blendshapes))


def to_millimetres(parts: FaceParts) -> list[FloatArray]:
    """(4, 4) from the space of each mesh."""
    world = world_to_world(parts.meters_per_unit, parts.up_axis, MILLIMETRES) @ parts.skeleton.transform
    return [np.asarray(world @ space) for space in mesh_spaces(parts)]
