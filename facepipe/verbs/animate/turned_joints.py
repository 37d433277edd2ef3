"""Turns of head and eyes as bone coefficients of joints, and what sliders of a performance do.

A performance has turns as yaw, pitch and roll in radians: yaw is positive to the person's own right, pitch down, roll
to the person's left shoulder, one after the other about the turned axes. Source: recordings of Live Link Face, where
the angles of the eyes move so with EyeLookIn, EyeLookOut, EyeLookUp and EyeLookDown, and their roll with yaw times
pitch.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, first_names
from facepipe.parts import FaceParts, Mesh, Skeleton, Slider
from facepipe.rig.bone_coefficients import coefficient_matrices, matrix_coefficients, rest_coefficients
from facepipe.rig.conventions import meaning, shape_key
from facepipe.rig.sliders import slide
from facepipe.rig.trs import decompose, rotation_matrices
from facepipe.verbs.animate.performance import Performance, angle_of

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
    matches = paths or last
    if len(matches) != 1:
        problem = (
            f"{len(matches)} joints '{wanted[:60]}' for {part}" if matches else f"no joint '{wanted[:60]}' for {part}"
        )
        names = [one.rpartition("/")[2] for one in skeleton.joints]
        some = first_names(names, 4) or "none, there are none"
        raise InputError(where, f"{problem}, expected a path or name of one: {some}{did_you_mean(wanted, names)}")
    return matches[0]


def _name(joint: str) -> str:
    return shape_key(_PREFIX.sub("", joint.rpartition("/")[2]))


def turned_by_sliders(sliders: Sequence[Slider], joint: str, chosen: Collection[str]) -> str | None:
    """A slider of those `chosen` that moves the joint."""
    found = (
        slider.name
        for slider in sliders
        if slider.name in chosen and any(joint == path for path, _, _ in slider.channels)
    )
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
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.zeros((len(angle), 3, 3))
    matrices[:, axis, axis] = 1.0
    matrices[:, first, first] = matrices[:, second, second] = np.cos(angle)
    matrices[:, second, first], matrices[:, first, second] = np.sin(angle), -np.sin(angle)
    return matrices


class Driven(NamedTuple):
    """What sliders do on top of the person."""

    coefficients: FloatArray  # (T, j, 9) of all joints
    weights: dict[str, FloatArray]  # shape -> (T,)


def driven(
    parts: FaceParts, tracks: Mapping[str, FloatArray], frames: int, done: Callable[[], object] = lambda: None
) -> Driven:
    """What the sliders of `tracks` do, all others at their defaults.

    :param tracks: slider -> (T,) weights: 0 is its default, 1 its maximum
    :param done: called after every frame
    """
    joints = parts.skeleton.joints
    at_rest = np.tile(rest_coefficients(len(joints)), (frames, 1, 1))
    if not tracks:
        return Driven(at_rest, {})
    needed = {*tracks, *(() if parts.slider_network is None else parts.slider_network.sliders)}
    sliders = [replace(slider, value=None) for slider in parts.sliders if slider.name in needed]
    values = {
        slider.name: slider.default + tracks[slider.name] * (slider.maximum - slider.default)
        for slider in sliders
        if slider.name in tracks
    }
    still, weights_still = slide(sliders, joints, network=parts.slider_network)
    coefficients, weights = at_rest, np.zeros((frames, len(names := parts.shapes)))
    for frame in range(frames):
        now = {name: float(track[frame]) for name, track in values.items()}
        coefficients[frame], own = slide(sliders, joints, now, parts.slider_network)
        weights[frame] = [own.get(name, 0.0) - weights_still.get(name, 0.0) for name in names]
        done()
    if (still != rest_coefficients(len(joints))).any():  # a network that is not quite 0 there
        # C = C_default D: D alone is motion, so that sliders at their defaults leave the face as it is
        matrices = np.linalg.inv(coefficient_matrices(still)) @ coefficient_matrices(coefficients)
        coefficients = matrix_coefficients(matrices)
    moved = np.asarray(weights.any(axis=0))
    return Driven(coefficients, {name: weights[:, i] for i, name in enumerate(names) if moved[i]})


def turned(first: FloatArray, then: FloatArray) -> FloatArray:
    """(T, 9) coefficients of the motion `then` within the turn `first`, both (T, 9)."""
    return matrix_coefficients(coefficient_matrices(first) @ coefficient_matrices(then))
