"""Where the face stands as a person: eyes, top, height; and how it has to move to stand as VRM wants it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import FaceParts, Mesh
from facepipe_gltf.placement import place, rest_worlds, space_of

# Parts of a person's height (Drillis and Contini 1966, after Winter, Biomechanics and Motor Control of Human Movement)
HIPS, CHIN = 0.53, 0.87
_HEADS = 6.0  # head heights in a person's height where no landmark says where the chin is: heads come with their necks
_SCHEME, _MARKS, _CHIN, _RIGHT_EYE, _LEFT_EYE = "multipie68", 68, 8, slice(36, 42), slice(42, 48)
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
    if marks is not None and high[1] > marks[_CHIN, 1]:
        height = (high[1] - marks[_CHIN, 1]) / (1 - CHIN)
    if "hips" in bones and high[1] > joints[bones["hips"], 1]:
        height = (high[1] - joints[bones["hips"], 1]) / (1 - HIPS)
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
    world = space_of(parts).world
    own = np.linalg.inv(world) @ matrix @ world
    meshes = tuple(replace(mesh, transform=own @ mesh.transform) for mesh in parts.meshes)
    return replace(
        parts, meshes=meshes, skeleton=replace(parts.skeleton, transform=own @ np.asarray(parts.skeleton.transform))
    )


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
    return None if any(one is None for one in lids) else np.stack([one for one in lids if one is not None])


def _moved_by(shape: str, meshes: tuple[Mesh, ...], points: list[FloatArray]) -> FloatArray | None:
    """(3,) the middle of the points that a shape moves, the farther the more."""
    rows: list[FloatArray] = [np.zeros((0, 3))]
    weights: list[FloatArray] = [np.zeros(0)]
    for mesh, own in zip(meshes, points, strict=True):
        for one in mesh.blendshapes:
            if one.name == shape:
                rows.append(own[np.asarray(one.point_indices)])
                weights.append(np.linalg.norm(np.asarray(one.offsets, np.float64), axis=1))
    total = np.concatenate(weights)
    return np.average(np.concatenate(rows), axis=0, weights=total) if total.sum() else None
