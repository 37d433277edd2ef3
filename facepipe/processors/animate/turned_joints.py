"""Turns of head and eyes as bone coefficients of joints.

A performance has them as yaw, pitch and roll in radians: yaw is positive to the person's own right, pitch down, roll to
the person's left shoulder, one after the other about the turned axes. Source: recordings of Live Link Face, where the
angles of the eyes move so with EyeLookIn, EyeLookOut, EyeLookUp and EyeLookDown, and their roll with yaw times pitch.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.parts import Mesh, Skeleton, Slider
from facepipe.processors.animate.angles import angle_of
from facepipe.processors.animate.performance import Performance
from facepipe.rig.bone_coefficients import matrix_coefficients, rest_coefficients
from facepipe.rig.conventions import meaning, shape_key
from facepipe.rig.trs import decompose, rotation_matrices

NONE = "none"
_NAMES = {  # of joints, as `shape_key` has them
    "Head": ("head",),
    "LeftEye": ("eyeleft", "eyeballleft", "eyejntleft", "eyejointleft"),
    "RightEye": ("eyeright", "eyeballright", "eyejntright", "eyejointright"),
}
_PREFIX = re.compile(r"^(mixamorig\d*|def|cc_base|c|facial|face)[:_\-]+", re.IGNORECASE)
_MOVES = 1e-6  # of the head's size: less is no motion
_HELD = 0.5  # weight from which a point belongs to a joint


def joint_of(where: str, skeleton: Skeleton, part: str, wanted: str | None) -> int | None:
    """The joint that a part turns: the one asked for, or the only one with a usual name nearest to the root.

    :param part: Head, LeftEye or RightEye
    :param wanted: its path or last name, or `NONE`
    :raises InputError: no such joint, or several
    """
    if wanted is not None:
        return None if wanted == NONE else _asked(where, skeleton, part, wanted)
    found = [i for i, joint in enumerate(skeleton.joints) if _name(joint) in _NAMES[part]]
    return min(found, key=lambda i: (skeleton.joints[i].count("/"), i), default=None)


def _asked(where: str, skeleton: Skeleton, part: str, wanted: str) -> int:
    paths = [i for i, joint in enumerate(skeleton.joints) if joint == wanted]
    last = [i for i, joint in enumerate(skeleton.joints) if joint.rpartition("/")[2].casefold() == wanted.casefold()]
    found = paths or last
    if len(found) != 1:
        what = f"{len(found)} joints '{wanted[:60]}' for {part}" if found else f"no joint '{wanted[:60]}' for {part}"
        names = [one.rpartition("/")[2] for one in skeleton.joints]
        some = ", ".join(names[:4]) + (" ..." if len(names) > 4 else "") or "none, there are none"
        raise InputError(where, f"{what}, expected a path or name of one: {some}{did_you_mean(wanted, names)}")
    return found[0]


def _name(joint: str) -> str:
    return shape_key(_PREFIX.sub("", joint.rpartition("/")[2]))


def turned_by_sliders(sliders: Sequence[Slider], joint: str, chosen: Collection[str]) -> str | None:
    """A slider of those `chosen` that moves the joint."""
    found = (one.name for one in sliders if one.name in chosen and any(joint == path for path, _, _ in one.channels))
    return next(found, None)


def turned_by_shapes(meshes: Sequence[Mesh], joint: int, side: str, shapes: Collection[str]) -> str | None:
    """A shape of `shapes` that looks around with the eye of `side` (Left, Right), by moving points of the joint."""
    meant = {shape: meaning(shape) or "" for shape in shapes}
    looks = {shape for shape, one in meant.items() if one.startswith("eyeLook") and one.endswith(side)}
    for mesh in meshes:
        if mesh.skin is None:
            continue
        held = (np.where(mesh.skin.joint_indices == joint, mesh.skin.joint_weights, 0.0)).sum(axis=1) > _HELD
        size = float(np.ptp(mesh.points, axis=0).max(initial=0.0))
        for shape in mesh.blendshapes:
            moved = np.abs(shape.offsets).max(axis=1, initial=0.0) > _MOVES * size
            if shape.name in looks and held[np.asarray(shape.point_indices)[moved]].any():
                return shape.name
    return None


def turns(skeleton: Skeleton, up_axis: str, joint: int, angles: FloatArray) -> FloatArray:
    """(T, 9) coefficients of a joint for (T, 3) yaw, pitch, roll about where it stands at rest."""
    yaw, pitch, roll = (np.asarray(angles, dtype=np.float64) * (-1.0, 1.0, -1.0)).T
    world = _about(yaw, 1) @ _about(pitch, 0) @ _about(roll, 2)
    if up_axis == "Z":  # what is (x, y, z) with Y up is (x, -z, y)
        axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        world = axes @ world @ axes.T
    rest = rotation_matrices(decompose(_rest_world(skeleton, joint)).rotation)
    matrices = np.tile(np.eye(4), (len(angles), 1, 1))
    matrices[:, :3, :3] = rest.T @ world @ rest
    found = np.repeat(rest_coefficients(1), len(angles), axis=0)
    found[:, 3:6] = matrix_coefficients(matrices)[:, 3:6]
    return found


def angles_of(performance: Performance, part: str) -> FloatArray:
    """(T, 3) yaw, pitch and roll of a part in radians; what a performance lacks of them is 0."""
    columns = {angle_of(name): column for name, column in zip(performance.names, performance.values.T, strict=True)}
    zero = np.zeros(len(performance.values))
    return np.stack([columns.get(f"{part}{angle}", zero) for angle in ("Yaw", "Pitch", "Roll")], axis=1)


def _rest_world(skeleton: Skeleton, joint: int) -> FloatArray:
    world = np.eye(4)
    while joint >= 0:
        world = np.asarray(skeleton.rest_transforms[joint], dtype=np.float64) @ world
        joint = int(skeleton.parents[joint])
    return np.asarray(skeleton.transform) @ world


def _about(angle: FloatArray, axis: int) -> FloatArray:
    """(T, 3, 3) right-handed rotations about an axis."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((len(angle), 3, 3))
    matrices[:, axis, axis] = 1.0
    matrices[:, one, one] = matrices[:, other, other] = np.cos(angle)
    matrices[:, other, one], matrices[:, one, other] = np.sin(angle), -np.sin(angle)
    return matrices
