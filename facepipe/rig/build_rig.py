"""From the parts of a face to its rig."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.rig import Curve, Rig, Target, curves

_Sculpt = tuple[str, int, Curve, npt.NDArray[np.int32], FloatArray]


def build(parts: FaceParts) -> Rig:
    """The rig of a face.

    :raises TopologyError: a singular bind transform, or indices and counts that don't fit
    """
    skeleton = parts.skeleton
    offsets = np.concatenate([[0], np.cumsum([len(mesh.points) for mesh in parts.meshes], dtype=np.int64)])
    spaces = mesh_spaces(parts)
    shapes = parts.shapes
    # geomBindTransform goes into the points, as each mesh has its own: one matrix a joint then serves all meshes
    points = [transformed(mesh.points, space) for space, mesh in zip(spaces, parts.meshes, strict=True)]
    by_mesh = [mesh.skin is not None and mesh.skin.dual_quaternion for mesh in parts.meshes]
    return Rig(
        name=parts.name,
        mesh_names=tuple(mesh.name for mesh in parts.meshes),
        mesh_offsets=offsets,
        points=np.concatenate(points) if points else np.zeros((0, 3)),
        shapes=shapes,
        targets=_targets(parts.meshes, offsets, spaces, shapes),
        joints=skeleton.joints,
        parents=skeleton.parents,
        rest=np.asarray(skeleton.rest_transforms, dtype=np.float64),
        inverse_bind=np.array(
            [
                inverse(bind, f"{parts.name} -> {skeleton.name} -> {joint}")
                for bind, joint in zip(skeleton.bind_transforms, skeleton.joints, strict=True)
            ]
        ).reshape(-1, 4, 4),
        parent_world=np.asarray(skeleton.transform, dtype=np.float64),
        influences=_influences(parts, offsets),
        dual=np.repeat(by_mesh, [len(mesh.points) for mesh in parts.meshes]) if any(by_mesh) else None,
    )


def mesh_spaces(parts: FaceParts) -> list[FloatArray]:
    """(4, 4) matrix of every mesh from its own space to skeleton space at bind time.

    :raises TopologyError: a singular skeleton transform
    """
    to_skeleton = inverse(parts.skeleton.transform, f"{parts.name} -> {parts.skeleton.name}")
    return [mesh.skin.geom_bind_transform if mesh.skin else to_skeleton @ mesh.transform for mesh in parts.meshes]


def inverse(matrix: FloatArray, where: str) -> FloatArray:
    """(4, 4) inverse.

    :raises TopologyError: there is none
    """
    try:
        result = np.linalg.inv(np.asarray(matrix, dtype=np.float64))
    except np.linalg.LinAlgError:
        result = np.full((4, 4), np.nan)
    if not np.isfinite(result).all():
        raise TopologyError(where, "singular matrix, expected an invertible one")
    return np.asarray(result)


def _influences(parts: FaceParts, offsets: npt.NDArray[np.int64]) -> sparse.csr_array:
    """(n, j + 1) weights; a mesh without skin follows the last column."""
    joint_count = len(parts.skeleton.joints)
    rows, columns, values = [], [], []
    for mesh, start in zip(parts.meshes, offsets[:-1], strict=True):
        numbers = np.arange(len(mesh.points)) + start
        indices = mesh.skin.joint_indices if mesh.skin else np.full((len(numbers), 1), joint_count)
        weights = mesh.skin.joint_weights if mesh.skin else np.ones((len(numbers), 1))
        limit = joint_count if mesh.skin else joint_count + 1
        if indices.size and not (indices.min() >= 0 and indices.max() < limit):
            raise TopologyError(f"{parts.name} -> {mesh.name}", f"joint index outside 0..{joint_count - 1}")
        rows.append(np.repeat(numbers, indices.shape[1]))
        columns.append(np.asarray(indices, dtype=np.int64).ravel())
        values.append(np.asarray(weights, dtype=np.float64).ravel())
    shape = (int(offsets[-1]), joint_count + 1)
    if not rows:
        return sparse.csr_array(shape)
    entries = (np.concatenate(rows), np.concatenate(columns))
    # entries of one point and joint are summed: a joint twice in a vertex is one influence
    matrix = sparse.csr_array((np.concatenate(values), entries), shape=shape)
    matrix.eliminate_zeros()
    return matrix


def _targets(
    meshes: tuple[Mesh, ...],
    offsets: npt.NDArray[np.int64],
    spaces: list[FloatArray],
    shapes: tuple[str, ...],
) -> tuple[Target, ...]:
    """Sculpts of all meshes; those of one shape, name and activation curve are one target."""
    number = {name: i for i, name in enumerate(shapes)}
    by_curve: dict[tuple[str, str, Curve], list[_Sculpt]] = {}
    for mesh, start, space in zip(meshes, offsets[:-1], spaces, strict=True):
        linear = space[:3, :3]
        turned = not np.array_equal(linear, np.eye(3))  # offsets that are not are shared with the parts: they are large
        for shape in mesh.blendshapes:
            indices = np.asarray(shape.point_indices)
            if indices.size and not (indices.min() >= 0 and indices.max() < len(mesh.points)):
                raise TopologyError(f"{mesh.name} -> {shape.name}", f"point index outside 0..{len(mesh.points) - 1}")
            by_weight = curves(tuple(inbetween.weight for inbetween in shape.inbetweens))
            for name, weight, sculpt in shape.sculpts:
                moved, curve = np.asarray(sculpt.offsets, dtype=np.float64), by_weight[weight]
                if len(moved) != len(indices):
                    raise TopologyError(f"{mesh.name} -> {name}", f"{len(moved)} offsets, expected {len(indices)}")
                if turned:
                    moved = moved @ linear.T
                sculpted = (name, number[shape.name], curve, (indices + start).astype(np.int32), moved)
                by_curve.setdefault((shape.name, name, curve), []).append(sculpted)
    targets = []
    for sculpts in by_curve.values():
        name, shape_number, curve, indices, offset_rows = sculpts[0]
        if len(sculpts) > 1:
            indices = np.concatenate([each for *_, each, _ in sculpts])
            offset_rows = np.concatenate([each for *_, each in sculpts])
        targets.append(Target(name=name, shape=shape_number, curve=curve, point_indices=indices, offsets=offset_rows))
    return tuple(sorted(targets, key=lambda target: target.shape))
