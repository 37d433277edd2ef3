"""Joints of the MakeHuman head: where they rest after targets, and how the pose units turn them."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import handles, unique_identifiers
from facepipe.importers.makehuman_data import MakeHumanData
from facepipe.parts import Animation, Skeleton
from facepipe.rig.bone_coefficients import matrix_coefficients

_SAME_PLACE = 1e-5  # decimetres: a plane point is the joint that it coincides with on the base mesh


def read_skeleton(data: MakeHumanData, points: FloatArray) -> Skeleton:
    """The skeleton of the head with `points` (V, 3), which targets may have moved.

    :raises InputError: the points leave a bone without length or rotation plane
    """
    world = rest_matrices(data, points)
    parents = data["bone_parent"]
    local = world.copy()
    local[1:] = np.linalg.solve(world[np.maximum(parents[1:], 0)], world[1:])
    local[parents < 0] = world[parents < 0]
    names = tuple(data.names("bone_names"))
    return Skeleton(joints=joint_paths(data), joint_names=names, bind_transforms=world, rest_transforms=local)


def joint_paths(data: MakeHumanData) -> tuple[str, ...]:
    """Paths like ``root/spine05/.../jaw``; a dot in a name becomes an underscore."""
    names = unique_identifiers(data.names("bone_names"))
    paths: list[str] = []
    for name, parent in zip(names, data["bone_parent"].tolist(), strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return tuple(paths)


def joint_positions(data: MakeHumanData, end: str, points: FloatArray) -> FloatArray:
    """(B, 3) means of the vertices that define every bone's `end` (``head`` or ``tail``)."""
    offsets = data[f"bone_{end}_vertices_offset"].astype(np.int64)
    sums = np.add.reduceat(points[data[f"bone_{end}_vertices"]], offsets[:-1], axis=0)
    return np.asarray(sums / np.diff(offsets)[:, None])


def rest_matrices(data: MakeHumanData, points: FloatArray) -> FloatArray:
    """(B, 4, 4) world matrices: Y along the bone, Z the normal of its rotation plane made orthogonal to Y, at its head.

    The points of a rotation plane are joints, and move with them. Where one is no joint of the head (those of clavicles
    and arms), it stays where it is on the base mesh.
    """
    heads, tails = (joint_positions(data, end, points) for end in ("head", "tail"))
    plane = _plane_points(data, np.concatenate([heads, tails]))
    y = _unit(data, tails - heads, "length")
    normal = np.cross(plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 1])
    z = _unit(data, normal - y * (y * normal).sum(axis=1, keepdims=True), "rotation plane")
    matrices = np.tile(np.eye(4), (len(y), 1, 1))
    matrices[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    matrices[:, :3, 3] = heads
    return matrices


def pose_units(data: MakeHumanData, skeleton: Skeleton) -> tuple[Animation, ...]:
    """A static animation per pose unit.

    A pose unit turns bone b by R_b along the axes of the mesh: ``world_b = [G_b B_b | q_b]`` with
    ``G_b = G_p R_b``, ``q_b = q_p + G_p (head_b - head_p)`` and B_b the rest axes. In the parent's axes that is
    ``B_p^T R_b B_b`` at the translation of rest.
    """
    from scipy.spatial.transform import Rotation

    axes = skeleton.bind_transforms[:, :3, :3]
    parents = skeleton.parents
    parent_axes = np.where(parents[:, None, None] >= 0, axes[parents], np.eye(3))
    names = handles(data.names("poseunit_names"), "pose")
    animations = []
    for name, vectors in zip(names, data["poseunit_rotvec"].astype(np.float64), strict=True):
        turned = Rotation.from_rotvec(vectors).as_matrix() @ axes
        animations.append(_pose(name, skeleton, np.swapaxes(parent_axes, 1, 2) @ turned))
    return tuple(animations)


def _pose(name: str, skeleton: Skeleton, rotations: FloatArray) -> Animation:
    from scipy.spatial.transform import Rotation

    local = skeleton.rest_transforms.copy()
    local[:, :3, :3] = rotations
    coefficients = matrix_coefficients(np.linalg.solve(skeleton.rest_transforms, local))
    coefficients[:, :3] = 0.0  # a pose unit only turns; this clears rounding
    coefficients[:, 6:] = 1.0
    return Animation(
        name=name,
        joints=skeleton.joints,
        translations=local[None, :, :3, 3],
        rotations=Rotation.from_matrix(rotations).as_quat(canonical=True)[None],
        scales=np.ones((1, len(local), 3)),
        coefficients=coefficients[None],
    )


def _plane_points(data: MakeHumanData, joints: FloatArray) -> FloatArray:
    """(B, 3, 3): each plane point follows the joint (own head and tail first) that it coincides with on the base."""
    base = np.concatenate([data["bone_head"], data["bone_tail"]]).astype(np.float64)
    count = len(base) // 2
    points = data["bone_plane_points"].astype(np.float64)
    for bone in range(count):
        for corner in range(3):
            same = np.linalg.norm(base - points[bone, corner], axis=1) < _SAME_PLACE
            candidates = [joint for joint in (bone, bone + count, *np.flatnonzero(same)) if same[joint]]
            if candidates:
                points[bone, corner] = joints[candidates[0]]
    return points


def _unit(data: MakeHumanData, vectors: FloatArray, what: str) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (lengths > 1e-9).all():
        bone = data.names("bone_names")[int(np.argmin(lengths))]
        raise InputError(f"{data.path} -> bone {bone}", f"has no {what} on these points")
    return np.asarray(vectors / lengths)
