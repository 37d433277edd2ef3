"""Faces restored from our own glTF files: the file's data put into its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reading import check_json
from facepipe.geometry.polygons import point_normals, triangulate
from facepipe.parts import Animation, Blendshape, FaceParts, Inbetween, Mesh, Skeleton, UvSet
from facepipe.rig.animation import local_transforms
from facepipe.rig.bone_coefficients import matrix_coefficients, rest_coefficients
from facepipe.rig.trs import decompose
from facepipe_gltf.read.document import Document
from facepipe_gltf.read.materials import with_recorded_images
from facepipe_gltf.record_format import (
    VERSION,
    MeshRecord,
    Record,
    content_digest,
    material_groups,
    points_back,
    shape_names,
    stepped,
    unpacked,
)

_SAME = 1e-4  # of the skeleton's size: what float32 and a warning tool's digits may cost
_NEAR = 2e-4  # seconds: what is nearer is one key
_NOISE = 5e-7  # what float32 leaves of a coefficient at rest
_VRM_LEVELS = 16  # as of a stage
_UNIT = 2e-7  # a direction this near to length 1 has it in float32


def _animation(
    record: Record,
    skeleton: Skeleton,
    husk: Animation,
    read: Animation,
    joints: IntArray,
    driven: IntArray,
    new_names: Mapping[str, str],
    shapes: Sequence[str],
) -> Animation:
    for numbers, count in ((joints, len(skeleton.joints)), (driven, len(shapes))):
        if numbers.ndim != 1 or (numbers.size and not (numbers.min() >= 0 and numbers.max() < count)):
            raise InputError(f"facepipe -> {husk.name}", f"numbers outside 0..{count - 1}")
    rows = np.zeros(1, np.int64)
    if husk.times is not None:
        # the samples that are keys of the record: inbetweens add more between them
        times = np.asarray(husk.times, np.float64)
        times = times - min(float(times.min(initial=0.0)), 0.0)
        read_times = np.zeros(1) if read.times is None else np.asarray(read.times, np.float64)
        after = np.minimum(np.searchsorted(read_times, times), len(read_times) - 1)
        before = np.maximum(after - 1, 0)
        rows = np.where(np.abs(read_times[before] - times) < np.abs(read_times[after] - times), before, after)
        if np.abs(read_times[rows] - times).max(initial=0.0) > _NEAR:
            raise InputError(f"facepipe -> {husk.name}", "other key times than facepipe wrote")
    names = tuple(shapes[i] for i in driven)
    weights = np.zeros((len(rows), len(names)), np.float32)
    column = {new_names.get(name): i for i, name in enumerate(read.shapes)}
    for i, shape in enumerate(names):
        if shape in column and read.shape_weights is not None:
            weights[:, i] = read.shape_weights[rows, column[shape]]
    result = replace(
        husk,
        times=None if husk.times is None else np.asarray(husk.times, np.float64),
        joints=tuple(record.face.skeleton.joints[i] for i in joints),
        shapes=names,
        shape_weights=None if husk.shape_weights is None else weights,
    )
    return _moved(record, skeleton, result, read, rows, joints) if len(joints) else result


def _moved(
    record: Record, skeleton: Skeleton, husk: Animation, read: Animation, rows: IntArray, joints: IntArray
) -> Animation:
    """The animation with the joint transforms, coefficients or both that it had."""
    recorded = record.face.skeleton
    local = np.repeat(np.asarray(recorded.rest_transforms, np.float64)[None], len(rows), axis=0)
    if read.joints:
        place = {joint: i for i, joint in enumerate(skeleton.joints)}
        used = np.array([place[joint] for joint in read.joints])
        moving = local_transforms(skeleton, read)[rows]
        local[:, used] = _stage_matrices(record, moving, skeleton.parents[used] < 0)
    local = local[:, joints]
    values: dict[str, FloatArray | None] = {}
    if husk.coefficients is not None:
        rest = np.asarray(recorded.rest_transforms, np.float64)[joints]
        # local = rest C; rounding of float32 nodes would make coefficients of joints that never moved
        coefficients = matrix_coefficients(np.linalg.inv(rest) @ local)
        # float32 coefficients without the noise of float32 nodes
        still = rest_coefficients(1)[0]
        reach = np.full(9, _NOISE)
        reach[:3] *= max(float(np.abs(rest[:, :3, 3]).max(initial=0.0)), 1.0)
        values["coefficients"] = np.asarray(
            np.where(np.abs(coefficients - still) <= reach, still, coefficients).astype(np.float32)
        )
    trs = decompose(local)
    for name, value in zip(("translations", "rotations", "scales"), trs[:3], strict=True):
        if getattr(husk, name) is not None:
            values[name] = value.astype(np.float32)
    return replace(husk, **values)  # type: ignore[arg-type]


def _stage_matrices(record: Record, matrices: FloatArray, roots: npt.NDArray[np.bool_]) -> FloatArray:
    """(..., j, 4, 4) local joint matrices of the file, as those of the stage."""
    result = np.array(matrices, np.float64)
    result[..., roots, :, :] = np.linalg.inv(record.placement) @ result[..., roots, :, :]
    return np.asarray(np.linalg.inv(record.axes) @ result @ record.axes)


def read_record(document: Document) -> Record | None:
    """The record of a file that facepipe wrote; None, with a warning where it is damaged or of another version."""
    ours = document.root.extras().get("facepipe")
    if ours is None or not isinstance(ours.data, dict):
        return None
    try:
        version = ours.require("version").integer()
        if version != VERSION:
            raise ours.error(f"version {version}, expected {VERSION}")
        if not isinstance(document.root.data, dict) or ours.data.get("digest") != content_digest(document.root.data):
            raise ours.error("another program has changed the file since facepipe wrote it")
        data, start, length = document.view(ours.require("bufferView"))
        size = ours.require("inflated").integer(4)
        document.budget.spend(4 * size, ours.error)
        return unpacked(bytes(data[start : start + length]), size, ours.trail)
    except InputError as error:
        document.warn(error.where, f"{error.what}: what glTF has no place for is left out")
        return None


def resampled(record: Record, read: FaceParts) -> Record:
    """The record with the key times of the animations that were read."""
    recorded = record.face.animations
    if len(recorded) != len(read.animations):
        raise _misfit(f"{len(read.animations)} animations, expected {len(recorded)}")
    clips = tuple(replace(one, times=other.times) for one, other in zip(recorded, read.animations, strict=True))
    return replace(record, face=replace(record.face, animations=clips, frames_per_second=read.frames_per_second))


def filled(document: Document, record: Record, read: FaceParts) -> FaceParts:
    """The face of the record, with what was `read` of the file.

    :param read: as in the file, its meshes not placed
    :raises InputError: the file does not fit the record
    """
    face = record.face
    check_json("facepipe", face.vrm, _VRM_LEVELS)
    counts = [len(read.meshes), len(face.meshes), len(record.meshes)]
    if len(set(counts)) > 1:
        raise _misfit(f"{counts[0]} meshes, expected {counts[1]}")
    skeleton, count = face.skeleton, len(face.skeleton.joints)
    sizes = {np.shape(one) for one in (skeleton.rest_transforms, skeleton.bind_transforms)}
    same_tree = len(read.skeleton.joints) == count and np.array_equal(read.skeleton.parents, skeleton.parents)
    if not same_tree or sizes != {(count, 4, 4)}:
        found_joints = len(read.skeleton.joints)
        raise InputError("facepipe", f"{found_joints} joints, expected {count} as facepipe wrote the file")
    if count:
        found = _stage_matrices(record, read.skeleton.rest_transforms, read.skeleton.parents < 0)
        size = float(np.abs(skeleton.rest_transforms).max())
        if float(np.abs(found - skeleton.rest_transforms).max()) > _SAME * size:
            raise InputError("facepipe", "joints moved by another program since facepipe wrote the file")
    # what fits in number is taken by place: names are the file's, and may have been made distinct on reading
    pairs = [*zip(face.meshes, record.meshes, read.meshes, strict=True)]
    meshes = tuple(_mesh(*pair) for pair in pairs)
    renamed = {
        one.name: other.name
        for own, _, found_mesh in pairs
        for one, other in zip(found_mesh.blendshapes, own.blendshapes, strict=True)
    }
    shapes = shape_names(face.meshes)
    recorded = face.animations
    if not len(recorded) == len(read.animations) == len(record.joints) == len(record.shapes):
        raise InputError("facepipe", f"{len(read.animations)} animations, expected {len(recorded)}")
    return replace(
        face,
        meshes=meshes,
        animations=tuple(
            _animation(record, read.skeleton, *of_animation, renamed, shapes)
            for of_animation in zip(recorded, read.animations, record.joints, record.shapes, strict=True)
        ),
        materials=with_recorded_images(document, face.materials, read.materials),
    )


def _misfit(what: str) -> InputError:
    return InputError("facepipe", f"{what}, as facepipe wrote the file")


def _mesh(husk: Mesh, record: MeshRecord, read: Mesh) -> Mesh:
    numbers = _numbers(husk, record, read)
    points = np.zeros((record.point_count, 3), np.float32)
    points[numbers] = points_back(record.matrix, read.points)
    if record.loose_points is not None and record.loose_positions is not None:
        if np.shape(record.loose_positions) != (len(record.loose_points), 3):
            raise _misfit(f"places of the points of {husk.name} that no face uses are not three numbers each")
        points[record.loose_points] = record.loose_positions
    # to glTF space and back in float32 loses last digits: the record has the steps by which each number misses
    if record.steps is not None:
        if np.shape(record.steps) != points.shape:
            raise _misfit(f"{len(points)} points of {husk.name}, expected {len(record.steps)}")
        points = stepped(points, record.steps)
    corners, counts = _corners(husk, record, read)
    directions = _Directions(record.matrix)
    indices = numbers[read.face_vertex_indices[corners]].astype(np.int32)
    colors = husk.colors
    if colors is not None and not len(colors):  # the file has them
        colors = None if read.colors is None else _spread(read.colors, numbers, record.point_count)
    normals = None
    if husk.normals is not None and read.normals is not None:
        back = directions.normal_offsets(read.normals, read.normals)
        per_point = len(back) == len(read.points)
        if husk.normals.ndim == 2:
            normals = _spread(back, numbers, record.point_count) if per_point else None
        else:
            normals = back[read.face_vertex_indices[corners]] if per_point else back[corners]
    uv_sets = _uv_sets(husk, read, record.point_count, corners, numbers, indices)
    if (husk.skin is None) != (read.skin is None):
        raise _misfit(f"skin weights of {husk.name} came or went")
    skin = husk.skin
    if skin is not None and read.skin is not None:
        weights = _spread(read.skin.joint_weights, numbers, record.point_count)
        if len(weights) > len(numbers):  # points that no face uses follow their first joint
            weights = np.array(weights)
            weights[np.setdiff1d(np.arange(record.point_count), numbers), 0] = 1.0
        joint_indices = _spread(read.skin.joint_indices, numbers, record.point_count)
        skin = replace(skin, joint_indices=joint_indices, joint_weights=weights)
    result = replace(
        husk,
        points=points,
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        normals=normals,
        uv_sets=uv_sets,
        colors=colors,
        skin=skin,
        blendshapes=_blendshapes(husk, read, numbers, directions),
        material=husk.material if len(husk.face_vertex_counts) else read.material,
        material_faces=husk.material_faces if len(husk.face_vertex_counts) else read.material_faces,
    )
    _check_points(result)
    return result


def _numbers(husk: Mesh, record: MeshRecord, read: Mesh) -> IntArray:
    """The number on the stage of every point that was read."""
    count = record.point_count
    loose = np.zeros(0, np.int32) if record.loose_points is None else record.loose_points
    if loose.ndim != 1 or (loose.size and not (loose.min() >= 0 and loose.max() < count)):
        raise _misfit(f"points of {husk.name} that no face uses are outside 0..{count - 1}")
    if count != len(read.points) + len(loose):
        raise _misfit(f"{len(read.points)} points of {husk.name}, expected {count - len(loose)}")
    if len(read.blendshapes) != len(husk.blendshapes):
        raise _misfit(f"{len(read.blendshapes)} shapes of {husk.name}, expected {len(husk.blendshapes)}")
    return np.setdiff1d(np.arange(count), loose)


def _corners(husk: Mesh, record: MeshRecord, read: Mesh) -> tuple[IntArray, IntArray]:
    """The corner (c,) among those read of every corner of the polygons, and how many each polygon has."""
    triangles = np.arange(len(read.face_vertex_indices)).reshape(-1, 3)
    if record.mirrored:
        triangles = triangles[:, ::-1]
    counts = np.asarray(husk.face_vertex_counts)
    if not len(counts):
        return triangles.ravel(), np.asarray(read.face_vertex_counts)
    if counts.min() < 3 or int((counts.astype(np.int64) - 2).sum()) != len(triangles):
        raise _misfit(f"{len(triangles)} triangles of {husk.name}, expected {int((counts - 2).sum())}")
    of_triangle = triangulate(counts).faces
    groups = material_groups(husk)[1]
    as_written = np.empty_like(triangles)
    as_written[np.argsort(groups[of_triangle], kind="stable")] = triangles  # primitives are one a material
    first = np.concatenate([[True], of_triangle[1:] != of_triangle[:-1]])
    pieces = np.where(first[:, None], as_written, -1)
    pieces[~first, 2] = as_written[~first, 2]  # a fan: one more corner a triangle
    corners = pieces.ravel()
    return corners[corners >= 0], counts.astype(np.int32)


class _Directions:
    """Normals and offsets of a file in mesh space."""

    def __init__(self, matrix: FloatArray) -> None:
        self._linear = np.asarray(matrix, np.float64)[:3, :3]
        self._back = np.linalg.inv(self._linear)
        self._scale = np.cbrt(abs(np.linalg.det(self._linear)))

    def offsets(self, values: FloatArray) -> FloatArray:
        return _summed(self._back, values).astype(np.float32)

    def normal_offsets(self, values: FloatArray, normals: FloatArray) -> FloatArray:
        """Offsets of normals, or normals themselves; `normals` (k, 3) are those of the same points in the file."""
        length = np.linalg.norm(_summed(self._linear.T, normals), axis=1)
        # the scale where that is all there is, so that unit normals keep their bits
        near = np.abs(length - self._scale) <= _UNIT * self._scale
        length = np.where(near, self._scale, np.where(length > 0.0, length, 1.0))
        return np.asarray((_summed(self._linear.T, values) / length[:, None]).astype(np.float32))


def _summed(matrix: FloatArray, values: FloatArray) -> FloatArray:
    x, y, z = np.asarray(values, np.float64).T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in matrix], axis=1)


def _spread(values: npt.NDArray[Any], numbers: IntArray, count: int) -> npt.NDArray[Any]:
    """Values of the points `numbers` as values of all; 0 at the others."""
    if len(values) == count:
        return values
    result = np.zeros((count, *values.shape[1:]), values.dtype)
    result[numbers] = values
    return result


def _uv_sets(
    husk: Mesh, read: Mesh, count: int, corners: IntArray, numbers: IntArray, indices: IntArray
) -> tuple[UvSet, ...]:
    if len(husk.uv_sets) != len(read.uv_sets):
        raise _misfit(f"{len(read.uv_sets)} UV sets of {husk.name}, expected {len(husk.uv_sets)}")
    result = []
    places: IntArray | None
    for husk_set, read_set in zip(husk.uv_sets, read.uv_sets, strict=True):
        if read_set.indices is not None:
            values, places = read_set.values, read_set.indices[corners]
        else:
            values, places = _spread(read_set.values, numbers, count), None if husk_set.indices is None else indices
        result.append(UvSet(name=husk_set.name, values=values, indices=places))
    return tuple(result)


def _blendshapes(husk: Mesh, read: Mesh, numbers: IntArray, directions: _Directions) -> tuple[Blendshape, ...]:
    normals = read.normals if read.normals is not None and len(read.normals) == len(read.points) else None
    if husk.normals is not None and husk.normals.ndim == 1:  # at corners: the writer goes by smooth ones of points
        normals = point_normals(read.points, read.face_vertex_indices.reshape(-1, 3))
    result = []
    for shape, read_shape in zip(husk.blendshapes, read.blendshapes, strict=True):
        at = normals[read_shape.point_indices] if normals is not None else np.zeros((len(read_shape.point_indices), 3))
        if len(shape.inbetweens) != len(read_shape.inbetweens):
            raise _misfit(f"{len(read_shape.inbetweens)} inbetweens of {shape.name}, expected {len(shape.inbetweens)}")
        # the file has inbetweens by weight, the face in its own order
        by_weight = dict(zip(np.argsort([one.weight for one in shape.inbetweens]), read_shape.inbetweens, strict=True))
        result.append(
            replace(
                shape,
                point_indices=numbers[read_shape.point_indices].astype(np.int32),
                offsets=directions.offsets(read_shape.offsets),
                normal_offsets=_turned_offsets(shape, read_shape, at, directions),
                inbetweens=tuple(
                    replace(
                        inbetween,
                        offsets=directions.offsets(by_weight[i].offsets),
                        normal_offsets=_turned_offsets(inbetween, by_weight[i], at, directions),
                    )
                    for i, inbetween in enumerate(shape.inbetweens)
                ),
            )
        )
    return tuple(result)


def _turned_offsets(
    husk: Blendshape | Inbetween, read: Blendshape | Inbetween, normals: FloatArray, directions: _Directions
) -> FloatArray | None:
    if husk.normal_offsets is None or read.normal_offsets is None:
        return None
    return directions.normal_offsets(read.normal_offsets, normals)


def _check_points(mesh: Mesh) -> None:
    """:raises InputError: data of the record that don't fit the points or faces"""
    # a record is bytes of a file: what it says of points that the file doesn't have must not reach a stage
    count = len(mesh.points)
    for name, mask in mesh.regions.items():
        if np.shape(mask) != (count,) or not np.isfinite(mask).all():
            raise _misfit(f"region {name[:40]} of {mesh.name} of {np.shape(mask)} weights, expected {count}")
    for name, subset in mesh.point_subsets.items():
        if subset.ndim != 1 or (subset.size and not (subset.min() >= 0 and subset.max() < count)):
            raise _misfit(f"points of the subset {name[:40]} outside 0..{count - 1}")
    marks = [one.indices for one in mesh.landmarks.values()] + [np.array([mesh.anchor or 0])]
    for points in marks:
        if points.ndim != 1 or (points.size and not (points.min() >= 0 and points.max() < count)):
            raise _misfit(f"landmarks of {mesh.name} outside 0..{count - 1}")
    if any(one.names and len(one.names) != len(one.indices) for one in mesh.landmarks.values()):
        raise _misfit(f"landmarks of {mesh.name} without a name each")
    if mesh.colors is not None and np.shape(mesh.colors) != (count, 3):
        raise _misfit(f"colours of {mesh.name} of {np.shape(mesh.colors)} numbers, expected {count} x 3")
    if np.shape(mesh.transform) != (4, 4) or (mesh.skin and np.shape(mesh.skin.geom_bind_transform) != (4, 4)):
        raise _misfit(f"a transform of {mesh.name} that is no matrix")
    material_groups(mesh)
