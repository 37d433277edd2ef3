"""The packed MakeHuman head as checked arrays, and its rig: where joints rest after targets, poses and sliders.

A pose unit at v turns each bone by v times its angle, about its axis (as quaternions interpolate). Euler angles follow
that in curves: straight pieces, as many as keep every angle within `_ANGLE`, twice as many until they do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import handles, unique_identifiers
from facepipe.importers.npz import Field, check_indices, read_arrays
from facepipe.parts import Animation, Curve, Skeleton, Slider
from facepipe.rig import CHANNELS, matrix_coefficients
from facepipe.rig.sliders import with_mutual_mirrors

Arrays = dict[str, npt.NDArray[Any]]

_FIELDS = {
    "vertices": Field("float", ("V", 3)),
    "source_vertex_index": Field("int", ("V",)),
    "vertex_kind": Field("int", ("V",)),
    "vertex_kind_names": Field("str", ("kinds",)),
    "faces": Field("int", ("F", 4)),
    "face_kind": Field("int", ("F",)),
    "uv": Field("float", ("U", 2)),
    "face_uv": Field("int", ("F", 4)),
    "bone_names": Field("str", ("B",)),
    "bone_parent": Field("int", ("B",)),
    "bone_plane_points": Field("float", ("B", 3, 3)),
    "bone_head": Field("float", ("B", 3)),
    "bone_tail": Field("float", ("B", 3)),
    "bone_head_vertices_offset": Field("int", ("B+1",)),
    "bone_head_vertices": Field("int", ("head vertices",)),
    "bone_tail_vertices_offset": Field("int", ("B+1",)),
    "bone_tail_vertices": Field("int", ("tail vertices",)),
    "skin_weights": Field("float", ("V", "B")),
    "target_names": Field("str", ("T",)),
    "target_offset": Field("int", ("T+1",)),
    "target_vertex": Field("int", ("D",)),
    "target_delta": Field("float", ("D", 3)),
    "region_names": Field("str", ("R",)),
    "region_strength": Field("float", ("R", "V")),
    "poseunit_names": Field("str", ("P",)),
    "poseunit_rotvec": Field("float", ("P", "B", 3)),
}
_SAME_PLACE = 1e-5  # decimetres: a plane point is the joint that it coincides with on the base mesh
_ANGLE = 2e-4  # radians that an angle may be off between two knots
_STILL = 1e-5  # radians that are rounding in the data: bones turned by less stay
_NOTHING = 1e-7  # radians of one angle that are none
_MOST = 32  # pieces
_BETWEEN = 4  # values of a piece at which angles are compared

_GROUPS = {  # words in the names of pose units
    "brows": ("Brow",),
    "eyes": ("Lid", "Eye"),
    "nose": ("Nose",),
    "cheeks": ("Cheek", "Nasolabial"),
    "tongue": ("Tongue",),
    "jaw": ("Jaw", "Chin"),
    "mouth": ("Lip", "Mouth"),
}

_LEFT_SIDE = {  # ARKit shape -> pose units, Left and Right exchanged for the other side
    "browDownLeft": ("LeftBrowDown",),
    "browOuterUpLeft": ("LeftOuterBrowUp",),
    "cheekSquintLeft": ("LeftCheekUp",),
    "eyeBlinkLeft": ("LeftUpperLidClosed",),
    "eyeLookDownLeft": ("LeftEyeDown",),
    "eyeLookInLeft": ("LeftEyeturnRight",),
    "eyeLookOutLeft": ("LeftEyeturnLeft",),
    "eyeLookUpLeft": ("LeftEyeUp",),
    "eyeSquintLeft": ("LeftLowerLidUp",),
    "eyeWideLeft": ("LeftUpperLidOpen",),
    "jawLeft": ("ChinLeft",),
    "mouthFrownLeft": ("MouthLeftPullDown",),
    "mouthLeft": ("MouthMoveLeft",),
    "mouthSmileLeft": ("MouthLeftPullUp",),
    "mouthStretchLeft": ("MouthLeftPullSide",),
}
_WHOLE = {
    "browInnerUp": ("LeftInnerBrowUp", "RightInnerBrowUp"),
    "cheekPuff": ("CheeksPump",),
    "jawForward": ("ChinForward",),
    "jawOpen": ("JawDrop",),
    "mouthFunnel": ("UpperLipForward", "lowerLipForward"),
    "mouthPucker": ("LipsKiss",),
    "mouthRollLower": ("lowerLipBackward",),
    "mouthRollUpper": ("UpperLipBackward",),
    "mouthShrugLower": ("lowerLipUp",),
    "tongueOut": ("TongueOut",),
}


@dataclass(frozen=True)
class MakeHumanData:
    """The arrays of the archive, by the names of its README, in the units of the base mesh (decimetres)."""

    path: Path
    arrays: Arrays

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self.arrays[name]

    def names(self, name: str) -> list[str]:
        """An array of strings as a list."""
        return [str(item) for item in self.arrays[name].tolist()]

    def points_of(self, kind: str) -> IntArray:
        """Ascending vertex numbers of one kind (``skin``, ``eye_left`` ...)."""
        return np.flatnonzero(self["vertex_kind"] == self.names("vertex_kind_names").index(kind))

    def target(self, number: int) -> FloatArray:
        """(V, 3) float64 deltas of one target."""
        start, end = (int(self["target_offset"][number + i]) for i in (0, 1))
        deltas = np.zeros(self["vertices"].shape)
        np.add.at(deltas, self["target_vertex"][start:end], self["target_delta"][start:end].astype(np.float64))
        return deltas


def read_data(path: Path) -> MakeHumanData:
    """Read and check the packed head.

    :raises InputError: an array that is missing, or values out of range
    :raises TopologyError: a face that joins vertices of two kinds
    """
    data = MakeHumanData(path, read_arrays(path, _FIELDS, {}))
    for name, limit in (
        ("faces", len(data["vertices"])),
        ("face_uv", len(data["uv"])),
        ("vertex_kind", len(data["vertex_kind_names"])),
        ("face_kind", len(data["vertex_kind_names"])),
    ):
        check_indices(f"{path} -> {name}", data[name], limit)
    _check_unique(data, "vertex_kind_names")
    if "skin" not in data.names("vertex_kind_names"):
        raise InputError(f"{path} -> vertex_kind_names", "no kind skin there")
    mixed = (data["vertex_kind"][data["faces"]] != data["face_kind"][:, None]).any(axis=1)
    if mixed.any():
        raise TopologyError(f"{path} -> faces", f"face {int(np.argmax(mixed))} joins vertices of two kinds")
    if (data["region_strength"] < 0).any():
        raise InputError(f"{path} -> region_strength", "negative strength, expected 0 or more")
    parents = data["bone_parent"]
    if len(parents) == 0 or parents[0] != -1 or (parents >= np.arange(len(parents))).any() or parents.min() < -1:
        raise InputError(f"{data.path} -> bone_parent", "expected a root first and every parent before its children")
    _check_unique(data, "bone_names")
    for end in ("head", "tail"):
        name = f"bone_{end}_vertices"
        check_indices(f"{data.path} -> {name}", data[name], len(data["vertices"]))
        _check_offsets(data, f"{name}_offset", len(data[name]), at_least=1)
    weights = data["skin_weights"]
    on_surface = np.unique(data["faces"])
    if (weights < 0).any() or (np.abs(weights[on_surface].sum(axis=1) - 1) > 1e-3).any():
        raise InputError(f"{data.path} -> skin_weights", "expected weights of 0 or more that sum to 1 per point")
    _check_unique(data, "target_names")
    check_indices(f"{data.path} -> target_vertex", data["target_vertex"], len(data["vertices"]))
    _check_offsets(data, "target_offset", len(data["target_vertex"]), at_least=0)
    _check_unique(data, "poseunit_names")
    _check_unique(data, "region_names")
    return data


def _check_offsets(data: MakeHumanData, name: str, end: int, at_least: int) -> None:
    offsets = data[name].astype(np.int64)
    if offsets[0] != 0 or offsets[-1] != end or (np.diff(offsets) < at_least).any():
        raise InputError(f"{data.path} -> {name}", f"expected ascending offsets from 0 to {end}")


def _check_unique(data: MakeHumanData, name: str) -> None:
    names = data.names(name)
    if len(set(names)) != len(names):
        raise InputError(f"{data.path} -> {name}", "a name occurs twice, expected each once")


def read_skeleton(data: MakeHumanData, points: FloatArray) -> Skeleton:
    """The skeleton of the head with `points` (V, 3), which targets may have moved.

    :raises InputError: the points leave a bone without length or rotation plane
    """
    # joints are means of the vertices that define every bone's head and tail
    ends = []
    for end in ("head", "tail"):
        offsets = data[f"bone_{end}_vertices_offset"].astype(np.int64)
        sums = np.add.reduceat(points[data[f"bone_{end}_vertices"]], offsets[:-1], axis=0)
        ends.append(sums / np.diff(offsets)[:, None])
    heads, tails = ends
    # the points of a rotation plane follow the joint (own head and tail first) that they coincide with on the base
    # mesh; one that is no joint of the head (those of clavicles and arms) stays where it is
    base, joints = np.concatenate([data["bone_head"], data["bone_tail"]]).astype(np.float64), np.concatenate(ends)
    plane = data["bone_plane_points"].astype(np.float64)
    for bone, corner in np.ndindex(len(heads), 3):
        same = np.linalg.norm(base - plane[bone, corner], axis=1) < _SAME_PLACE
        candidates = [joint for joint in (bone, bone + len(heads), *np.flatnonzero(same)) if same[joint]]
        if candidates:
            plane[bone, corner] = joints[candidates[0]]
    # (B, 4, 4) world matrices: Y along the bone, Z the normal of its rotation plane made orthogonal to Y, at its head
    y = _unit(data, tails - heads, "length")
    normal = np.cross(plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 1])
    z = _unit(data, normal - y * (y * normal).sum(axis=1, keepdims=True), "rotation plane")
    world = np.tile(np.eye(4), (len(y), 1, 1))
    world[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    world[:, :3, 3] = heads
    parents = data["bone_parent"]
    local = world.copy()
    local[1:] = np.linalg.solve(world[np.maximum(parents[1:], 0)], world[1:])
    local[parents < 0] = world[parents < 0]
    names = tuple(data.names("bone_names"))
    paths: list[str] = []  # like root/spine05/.../jaw; a dot in a name becomes an underscore
    for name, parent in zip(unique_identifiers(names), parents.tolist(), strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return Skeleton(joints=tuple(paths), joint_names=names, bind_transforms=world, rest_transforms=local)


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
        rotations = np.swapaxes(parent_axes, 1, 2) @ turned
        local = skeleton.rest_transforms.copy()
        local[:, :3, :3] = rotations
        coefficients = matrix_coefficients(np.linalg.solve(skeleton.rest_transforms, local))
        coefficients[:, :3] = 0.0  # a pose unit only turns; this clears rounding
        coefficients[:, 6:] = 1.0
        animations.append(
            Animation(
                name=name,
                joints=skeleton.joints,
                translations=local[None, :, :3, 3],
                rotations=Rotation.from_matrix(rotations).as_quat(canonical=True)[None],
                scales=np.ones((1, len(local), 3)),
                coefficients=coefficients[None],
            )
        )
    return tuple(animations)


def _unit(data: MakeHumanData, vectors: FloatArray, what: str) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not (lengths > 1e-9).all():
        bone = data.names("bone_names")[int(np.argmin(lengths))]
        raise InputError(f"{data.path} -> bone {bone}", f"has no {what} on these points")
    return np.asarray(vectors / lengths)


def other_side(name: str) -> str:
    """The name with left and right exchanged."""
    return name.replace("Left", "\0").replace("Right", "Left").replace("\0", "Right")


ARKIT_UNITS: Mapping[str, tuple[str, ...]] = {
    **_WHOLE,
    **_LEFT_SIDE,
    **{other_side(name): tuple(map(other_side, units)) for name, units in _LEFT_SIDE.items()},
}


def unit_sliders(data: MakeHumanData, skeleton: Skeleton) -> tuple[Slider, ...]:
    """A slider, 0 to 1, of each pose unit that turns something, called as the pose unit."""
    names = unique_identifiers(data.names("poseunit_names"))
    return _sliders(
        {name: (unit,) for name, unit in zip(names, data.names("poseunit_names"), strict=True)}, data, skeleton
    )


def arkit_sliders(data: MakeHumanData, skeleton: Skeleton) -> tuple[Slider, ...]:
    """A slider of each ARKit shape whose pose units (`ARKIT_UNITS`) are all there."""
    there = set(data.names("poseunit_names"))
    return _sliders({name: units for name, units in ARKIT_UNITS.items() if there.issuperset(units)}, data, skeleton)


def _sliders(units: Mapping[str, Sequence[str]], data: MakeHumanData, skeleton: Skeleton) -> tuple[Slider, ...]:
    numbers = {name: number for number, name in enumerate(data.names("poseunit_names"))}
    vectors = data["poseunit_rotvec"].astype(np.float64)
    vectors = np.where(np.linalg.norm(vectors, axis=2, keepdims=True) > _STILL, vectors, 0.0)
    axes = skeleton.bind_transforms[:, :3, :3]
    sliders = []
    for name, unit_names in units.items():
        knots = _knots([np.einsum("bji,bj->bi", axes, vectors[numbers[unit]]) for unit in unit_names])
        channels: list[tuple[str, str, float]] = []
        curves: list[Curve | None] = []
        values = np.linspace(0.0, 1.0, len(knots)).tolist()
        for joint, channel in np.argwhere(np.abs(knots).max(axis=0) > _NOTHING).tolist():
            angles, driven = knots[:, joint, channel], (skeleton.joints[joint], CHANNELS[3 + channel])
            if len(angles) == 2:
                channels.append((*driven, float(angles[1])))
                curves.append(None)
                continue
            # curves never turn back: an angle that does is the sum of what rises and what falls
            for sign in (1.0, -1.0):
                risen = np.concatenate([[0.0], np.cumsum(np.maximum(sign * np.diff(angles), 0.0))])
                if risen[-1] > _NOTHING:
                    channels.append((*driven, float(sign * risen[-1])))
                    curves.append(tuple(zip(values, (risen / risen[-1]).tolist(), strict=True)))
        if channels:
            group = (group for group, words in _GROUPS.items() if any(word in unit_names[0] for word in words))
            sliders.append(
                Slider(
                    name=name,
                    group=next(group, ""),
                    channels=tuple(channels),
                    channel_curves=tuple(curves) if any(curves) else (),
                    mirror=other_side(name) if other_side(name) != name else None,
                )
            )
    return with_mutual_mirrors(sliders)


def _knots(turns: Sequence[FloatArray]) -> FloatArray:
    """(pieces + 1, B, 3) Euler angles of rotations, one after another, from 0 to 1."""
    pieces = 1
    while True:
        knots, fine = _angles(turns, pieces), _angles(turns, _BETWEEN * pieces)
        at = np.linspace(0.0, 1.0, _BETWEEN, endpoint=False)[:, None, None]
        between = np.concatenate([knots[:-1, None] * (1.0 - at) + knots[1:, None] * at]).reshape(-1, *knots.shape[1:])
        if pieces >= _MOST or np.abs(between - fine[:-1]).max(initial=0.0) <= _ANGLE:
            return knots
        pieces *= 2


def _angles(turns: Sequence[FloatArray], pieces: int) -> FloatArray:
    """(pieces + 1, B, 3) rx ry rz of bones, along their own axes, at even values from 0 to 1.

    :param turns: (B, 3) rotation vectors along the axes of each bone
    """
    from scipy.spatial.transform import Rotation

    values = np.linspace(0.0, 1.0, pieces + 1)
    matrices = np.tile(np.eye(4), (len(values), len(turns[0]), 1, 1))
    for vectors in turns:
        rotated = Rotation.from_rotvec((values[:, None, None] * vectors).reshape(-1, 3)).as_matrix()
        matrices[..., :3, :3] = matrices[..., :3, :3] @ rotated.reshape(*matrices.shape[:2], 3, 3)
    return np.asarray(matrix_coefficients(matrices)[..., 3:6])
