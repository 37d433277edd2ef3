"""The body below a face: its measures, and the human bones that it lacks as nodes that move no point, arms held out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts, Mesh
from facepipe.rig.trs import rest_worlds
from facepipe_gltf.placement import place, space_of
from facepipe_gltf.vrm.bones import REQUIRED, SIDES, TORSO
from facepipe_gltf.vrm.nodes import NodeTree

# Parts of a person's height (Drillis and Contini 1966, after Winter, Biomechanics and Motor Control of Human Movement)
_HIPS, _CHIN = 0.53, 0.87
_SPINE, _SHOULDER, _SKULL = 0.58, 0.818, 0.905
_KNEE, _ANKLE = 0.285, 0.039
_SHOULDER_OUT, _UPPER_ARM, _FOREARM = 0.129, 0.186, 0.146
_LEG_OUT = 0.055
_HEADS = 6.0  # head heights in a person's height where no landmark says where the chin is: heads come with their necks
_SCHEME, _MARKS, _CHIN_MARK, _RIGHT_EYE, _LEFT_EYE = "multipie68", 68, 8, slice(36, 42), slice(42, 48)
_QUARTER = math.pi / 2


@dataclass(frozen=True)
class Figure:
    """Measures of a face in glTF space: metres, Y up."""

    eyes: FloatArray | None  # (2, 3) left, right; None: not known
    low: FloatArray  # (3,) of the rest bounding box
    high: FloatArray  # (3,)
    height: float  # of the standing person
    joints: FloatArray  # (j, 3) at rest

    @property
    def middle(self) -> FloatArray:
        """(3,) between the eyes where they are known, on the middle of the head's depth."""
        center = (self.low + self.high) / 2
        return center if self.eyes is None else np.array([self.eyes[:, 0].mean(), self.eyes[:, 1].mean(), center[2]])


def figure_of(parts: FaceParts, bones: Mapping[str, int]) -> Figure:
    """The measures of a face whose human `bones` are these joints."""
    space = space_of(parts)
    points = [place(mesh, parts.skeleton, space, skinned=False).points(mesh.points) for mesh in parts.meshes]
    every = np.concatenate([np.zeros((0, 3)), *points])
    low, high = (every.min(axis=0), every.max(axis=0)) if len(every) else (np.zeros(3), np.ones(3))
    joints = (space.skeleton @ rest_worlds(parts.skeleton))[:, :3, 3]
    height = _HEADS * (high[1] - low[1])
    marks = _landmarks(parts.meshes, points)
    if marks is not None and high[1] > marks[_CHIN_MARK, 1]:
        height = (high[1] - marks[_CHIN_MARK, 1]) / (1 - _CHIN)
    if "hips" in bones and high[1] > joints[bones["hips"], 1]:
        height = (high[1] - joints[bones["hips"], 1]) / (1 - _HIPS)
    return Figure(_eyes(bones, joints, marks, parts.meshes, points), low, high, float(height), joints)


def turned_to_front(parts: FaceParts, figure: Figure) -> tuple[FaceParts, int]:
    """The face looking along +Z, and the degrees by which it turned about the up axis: a multiple of 90."""
    if figure.eyes is None:
        return parts, 0
    x, y, z = figure.eyes[0] - figure.eyes[1]
    steps = round(math.atan2(z, x) / _QUARTER) % 4  # the left eye of who looks along +Z is on the side of +X
    if not steps or abs(y) > math.hypot(x, z):
        return parts, 0
    sine, cosine, degrees = {1: (1, 0, 90), 2: (0, -1, 180), 3: (-1, 0, -90)}[steps]
    turn = np.eye(4)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = cosine, sine, -sine, cosine
    return moved(parts, turn), degrees


def moved(parts: FaceParts, matrix: FloatArray) -> FaceParts:
    """The whole face moved by a rigid `matrix` (4, 4) of glTF space."""
    world = parts.gltf_axes
    return parts.placed(np.linalg.inv(world) @ matrix @ world)


def _landmarks(meshes: tuple[Mesh, ...], points: list[FloatArray]) -> FloatArray | None:
    """(68, 3) where some mesh has them."""
    for mesh, own in zip(meshes, points, strict=True):
        if _SCHEME in mesh.landmarks and len(mesh.landmarks[_SCHEME].indices) == _MARKS:
            return np.asarray(own[np.asarray(mesh.landmarks[_SCHEME].indices)])
    return None


def _eyes(
    bones: Mapping[str, int],
    joints: FloatArray,
    marks: FloatArray | None,
    meshes: tuple[Mesh, ...],
    points: list[FloatArray],
) -> FloatArray | None:
    """(2, 3) left and right eye: joints, else landmarks, else where the shapes of blinking move points."""
    if "leftEye" in bones and "rightEye" in bones:
        return np.asarray(joints[[bones["leftEye"], bones["rightEye"]]])
    if marks is not None:
        return np.stack([marks[_LEFT_EYE].mean(axis=0), marks[_RIGHT_EYE].mean(axis=0)])
    lids = [_moved_by(f"eyeBlink{side}", meshes, points) for side in ("Left", "Right")]
    return None if any(lid is None for lid in lids) else np.stack([lid for lid in lids if lid is not None])


def _moved_by(shape: str, meshes: tuple[Mesh, ...], points: list[FloatArray]) -> FloatArray | None:
    """(3,) the middle of the points that a shape moves, the farther the more."""
    rows: list[FloatArray] = [np.zeros((0, 3))]
    weights: list[FloatArray] = [np.zeros(0)]
    for mesh, mesh_points in zip(meshes, points, strict=True):
        for blendshape in mesh.blendshapes:
            if blendshape.name == shape:
                rows.append(mesh_points[np.asarray(blendshape.point_indices)])
                weights.append(np.linalg.norm(np.asarray(blendshape.offsets, np.float64), axis=1))
    total = np.concatenate(weights)
    return np.average(np.concatenate(rows), axis=0, weights=total) if total.sum() else None


def missing_bones(present: Sequence[str]) -> tuple[str, ...]:
    """The required bones that are not there, in the specification's order."""
    return tuple(bone for bone in REQUIRED if bone not in present)


def standing_place(figure: Figure, hips: int | None) -> FloatArray:
    """(3,) offset that puts the face on a body that stands on the ground; sideways only where the whole body is new."""
    if hips is not None:
        return np.array([0.0, _HIPS * figure.height - figure.joints[hips, 1], 0.0])
    return np.array([-figure.middle[0], figure.height - figure.high[1], -figure.middle[2]])


def add_body(tree: NodeTree, bones: dict[str, int], figure: Figure, roots: Sequence[int]) -> None:
    """Add what is missing of the required human bones.

    :param bones: human bone -> node; grows
    :param figure: measures of the face where it stands now
    :param roots: nodes of the skeleton at the scene's root
    """
    own_torso = [bone for bone in TORSO if bone in bones]
    if "hips" not in bones:
        root = tree.add("root", np.zeros(3), None)
        legs = [tree.world(bones[f"{side}UpperLeg"])[:3, 3] for side in SIDES if f"{side}UpperLeg" in bones]
        bones["hips"] = tree.add("hips", np.mean(legs, axis=0) if len(legs) == 2 else _at(figure, _HIPS), root)
    if "spine" not in bones:
        _add_spine(tree, bones, figure, own_torso)
    elif "hips" not in own_torso:
        tree.hang(tree.path(bones["spine"])[-1], bones["hips"])
    if "head" not in bones:
        bones["head"] = tree.add("head", _at(figure, _SKULL), bones["spine"])
        for root in roots:
            tree.hang(root, bones["head"])
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        _add_leg(tree, bones, figure, side, sign)
        _add_arm(tree, bones, figure, side, sign)


def _add_spine(tree: NodeTree, bones: dict[str, int], figure: Figure, own_torso: Sequence[str]) -> None:
    """A spine above the hips, and what hangs there now above the spine."""
    next_up = next((bone for bone in own_torso if bone != "hips"), None)
    if "hips" not in own_torso:
        bones["spine"] = tree.add("spine", _at(figure, _SPINE), bones["hips"])
        if next_up is not None:
            tree.hang(tree.path(bones[next_up])[-1], bones["spine"])
        return
    low = tree.world(bones["hips"])[:3, 3]
    up = _at(figure, _SKULL) if next_up is None else tree.world(bones[next_up])[:3, 3]
    part = (_SPINE - _HIPS) / (_SKULL - _HIPS)
    bones["spine"] = tree.add("spine", low + part * (up - low), bones["hips"])
    arms = [f"{side}{part}" for side in SIDES for part in ("Shoulder", "UpperArm")]
    for bone in (one for one in (next_up, *arms) if one in bones):
        path = tree.path(bones[bone])
        if bones["spine"] not in path and bones["hips"] in path:
            tree.hang(path[path.index(bones["hips"]) - 1], bones["spine"])


def _add_leg(tree: NodeTree, bones: dict[str, int], figure: Figure, side: str, sign: float) -> None:
    upper, lower, foot = (f"{side}{part}" for part in ("UpperLeg", "LowerLeg", "Foot"))
    if upper not in bones:
        x, y, z = tree.world(bones["hips"])[:3, 3]
        bones[upper] = tree.add(upper, np.array([x + sign * _LEG_OUT * figure.height, y, z]), bones["hips"])
    for bone, above, part in ((lower, upper, _KNEE / _HIPS), (foot, lower, _ANKLE / _KNEE)):
        if bone not in bones:
            place = tree.world(bones[above])[:3, 3] * (1, part, 1)
            bones[bone] = tree.add(bone, place, bones[above])


def _add_arm(tree: NodeTree, bones: dict[str, int], figure: Figure, side: str, sign: float) -> None:
    upper, lower, hand = (f"{side}{part}" for part in ("UpperArm", "LowerArm", "Hand"))
    if upper not in bones:
        parent = next(bones[one] for one in (f"{side}Shoulder", "upperChest", "chest", "spine") if one in bones)
        place = _at(figure, _SHOULDER)
        place[0] += sign * _SHOULDER_OUT * figure.height
        bones[upper] = tree.add(upper, place, parent)
    for bone, above, part in ((lower, upper, _UPPER_ARM), (hand, lower, _FOREARM)):
        if bone not in bones:
            place = tree.world(bones[above])[:3, 3]
            place[0] += sign * part * figure.height
            bones[bone] = tree.add(bone, place, bones[above])


def _at(figure: Figure, part: float) -> FloatArray:
    """(3,) at a part of the person's height, below the middle of the head."""
    return np.array([figure.middle[0], part * figure.height, figure.middle[2]])
