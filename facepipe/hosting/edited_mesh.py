"""A mesh that went through a host: what the host changed is taken from it, all else stays what it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import Blendshape, Inbetween, Mesh, Skin, UvSet
from facepipe.verbs.blend.normals import normal_offsets

_SHARE = 1e-6  # weights and masks, UVs and colours nearer than this are the same
_STEPS = 2.0**-22  # of the largest coordinate: what float32 loses in base + offset - base

Offsets = tuple[FloatArray, ...]


def same_topology(mesh: Mesh, other: Mesh) -> bool:
    """Whether two meshes have the same number of points and the same faces."""
    return (
        len(mesh.points) == len(other.points)
        and np.array_equal(mesh.face_vertex_counts, other.face_vertex_counts)
        and np.array_equal(mesh.face_vertex_indices, other.face_vertex_indices)
    )


def edited_mesh(kept: Mesh, made: Mesh) -> Mesh:
    """`made` with the values of `kept` wherever they are the same in the precision of a host, and what it can't hold.

    :param kept: the mesh before
    :param made: the mesh of the same topology as it is now; its blendshapes without normal offsets
    """
    step = _STEPS * float(np.abs(kept.points).max(initial=1e-6))
    moved = bool(np.abs(made.points - kept.points).max(initial=0.0) > step)
    shapes = {shape.name: shape for shape in kept.blendshapes}
    result = replace(
        kept,
        points=made.points if moved else kept.points,
        normals=made.normals if moved and kept.normals is not None else kept.normals,
        uv_sets=_uv_sets(kept, made),
        colors=kept.colors if _near(kept.colors, made.colors) else made.colors,
        blendshapes=tuple(
            _edited_shape(shapes.get(blendshape.name), blendshape, len(kept.points), step)
            for blendshape in made.blendshapes
        ),
        regions=kept.regions if _same_regions(kept.regions, made.regions) else summed_to_one(made.regions),
        point_subsets=_subsets(kept.point_subsets, made.point_subsets),
        skin=_skin(kept.skin, made.skin, len(kept.points)),
        material=_material(kept, made),
        material_faces=made.material_faces,
    )
    again = {
        blendshape.name for blendshape in result.blendshapes if moved or blendshape is not shapes.get(blendshape.name)
    }
    return with_normal_offsets(result, again)


def _edited_shape(kept: Blendshape | None, made: Blendshape, count: int, step: float) -> Blendshape:
    """The shape as it is now; `kept` itself where nothing in it moved by more than `step`."""
    if kept is None:
        return made
    old, new = _sculpts(kept, count), _sculpts(made, count)
    same = {name: np.abs(old[name] - new[name]).max(axis=1) <= step for name in new if name in old}
    weights = {inbetween.name: inbetween.weight for inbetween in kept.inbetweens}
    at = {inbetween.name: inbetween.weight for inbetween in made.inbetweens}
    if old.keys() == new.keys() and weights == at and all(mask.all() for mask in same.values()):
        return kept
    mixed = {name: np.where(same[name][:, None], old[name], new[name]) if name in same else new[name] for name in new}
    touched = np.flatnonzero(np.any([np.any(one != 0, axis=1) for one in mixed.values()], axis=0))
    return sculpted(made.name, mixed[""], {name: (at[name], mixed[name]) for name in at}, touched)


def sculpted(
    name: str,
    offsets: FloatArray,
    inbetweens: Mapping[str, tuple[float, FloatArray]],
    touched: IntArray | None = None,
) -> Blendshape:
    """A blendshape of dense offsets (n, 3), and of inbetweens name -> (weight, offsets (n, 3)).

    :param touched: indices of the points it holds; default those that some sculpt moves
    """
    if touched is None:
        dense = [offsets, *(one for _, one in inbetweens.values())]
        touched = np.flatnonzero(np.any([np.any(one != 0, axis=1) for one in dense], axis=0))
    return Blendshape(
        name=name,
        point_indices=touched.astype(np.int32),
        offsets=offsets[touched].astype(np.float32),
        inbetweens=tuple(
            Inbetween(name=inbetween, weight=weight, offsets=dense[touched].astype(np.float32))
            for inbetween, (weight, dense) in sorted(inbetweens.items(), key=lambda item: item[1][0])
        ),
    )


def with_normal_offsets(mesh: Mesh, names: set[str]) -> Mesh:
    """The mesh with the normal offsets of some of its shapes computed from its surface."""
    if not names:
        return mesh
    triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
    points = np.asarray(mesh.points, dtype=np.float64)

    def turned(at: IntArray, offsets: FloatArray) -> FloatArray:
        deformed = points.copy()
        deformed[at] += offsets
        return normal_offsets(points, deformed, triangles, at).astype(np.float32)

    def with_normals(shape: Blendshape) -> Blendshape:
        at = shape.point_indices
        between = tuple(
            replace(inbetween, normal_offsets=turned(at, inbetween.offsets)) for inbetween in shape.inbetweens
        )
        return replace(shape, normal_offsets=turned(at, shape.offsets), inbetweens=between)

    return replace(
        mesh,
        blendshapes=tuple(
            with_normals(blendshape) if blendshape.name in names else blendshape for blendshape in mesh.blendshapes
        ),
    )


def _same_regions(one: Mapping[str, FloatArray], other: Mapping[str, FloatArray]) -> bool:
    """Whether two sets of masks agree in names and, nearly, in values."""
    return one.keys() == other.keys() and all(_near(one[name], other[name]) for name in one)


def summed_to_one(regions: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The masks with sum 1 at every point that is in some."""
    if not regions:
        return {}
    total = np.sum([np.asarray(mask, np.float64) for mask in regions.values()], axis=0)
    return {name: (mask / np.where(total > 0, total, 1.0)).astype(np.float32) for name, mask in regions.items()}


def joint_table(skin: Skin, points: int) -> dict[int, FloatArray]:
    """Joint -> (n,) weights, of joints with some."""
    table: dict[int, FloatArray] = {}
    for joint in np.unique(skin.joint_indices[skin.joint_weights != 0]).tolist():
        table[joint] = np.where(skin.joint_indices == joint, skin.joint_weights, 0.0).sum(axis=1).reshape(points)
    return table


def _skin(kept: Skin | None, made: Skin | None, points: int) -> Skin | None:
    if kept is None or made is None:
        return made
    old, new = joint_table(kept, points), joint_table(made, points)
    none = np.zeros(points)
    if all(_near(old.get(joint, none), new.get(joint, none)) for joint in {*old, *new}):
        return kept
    return replace(made, geom_bind_transform=kept.geom_bind_transform)


def _material(kept: Mesh, made: Mesh) -> str | None:
    """The material of the whole mesh; where each face has its own, as hosts store them, the one from before."""
    there = kept.material in {material_face.material for material_face in made.material_faces}
    return kept.material if made.material is None and there else made.material


def _uv_sets(kept: Mesh, made: Mesh) -> tuple[UvSet, ...]:
    old = {uv_set.name: uv_set for uv_set in kept.uv_sets}

    def corners(uv: UvSet, mesh: Mesh) -> FloatArray:
        return np.asarray(uv.values[mesh.face_vertex_indices if uv.indices is None else uv.indices])

    return tuple(
        old[uv_set.name]
        if uv_set.name in old and _near(corners(old[uv_set.name], kept), corners(uv_set, made))
        else uv_set
        for uv_set in made.uv_sets
    )


def _subsets(kept: Mapping[str, IntArray], made: Mapping[str, IntArray]) -> dict[str, npt.NDArray[np.integer]]:
    def same(name: str) -> bool:
        return name in kept and np.array_equal(np.unique(kept[name]), np.unique(made[name]))

    return {name: kept[name] if same(name) else made[name] for name in made}


def _sculpts(shape: Blendshape, count: int) -> dict[str, FloatArray]:
    """Dense offsets (n, 3) of the shape, called '', and of its inbetweens by name."""
    offsets_by_name = {}
    for name, offsets in [
        ("", shape.offsets),
        *((inbetween.name, inbetween.offsets) for inbetween in shape.inbetweens),
    ]:
        dense = np.zeros((count, 3), dtype=np.float32)
        dense[shape.point_indices] = offsets
        offsets_by_name[name] = dense
    return offsets_by_name


def _near(one: FloatArray | None, other: FloatArray | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.shape(one) == np.shape(other) and bool(np.abs(np.subtract(one, other)).max(initial=0.0) <= _SHARE)
