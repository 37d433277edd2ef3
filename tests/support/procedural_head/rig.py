"""The face's joints. All are world-aligned at rest: X to the subject's left, Y up, Z forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Skeleton
from procedural_head import eyes, mouth, topology
from procedural_head.fields import HINGE
from procedural_head.identity import Identity

HEAD = "root/neck/head"
JAW = "root/neck/head/jaw"
# Joints on the skin: path, grid column and row of the point they sit at. "Left" ones get a twin on the right.
_ON_GRID = (
    (f"{HEAD}/forehead", 0, 5),
    (f"{HEAD}/browInnerLeft", 7, 8),
    (f"{HEAD}/browMidLeft", 13, 8),
    (f"{HEAD}/browOuterLeft", 18, 8),
    (f"{HEAD}/noseBridge", 0, 17),
    (f"{HEAD}/noseTip", 0, 25),
    (f"{HEAD}/noseTip/nostrilLeft", 6, 25),
    (f"{HEAD}/cheekUpperLeft", 17, 23),
    (f"{HEAD}/cheekLowerLeft", 19, 34),
    (f"{JAW}/jowlLeft", 20, 46),
    (f"{JAW}/chin", 0, 48),
)
# Joints on the lips: path, spoke of the mouth patch as a share of the way from the left corner to the right one.
_ON_LIPS = (
    (f"{HEAD}/lipUpper", 0.5, True),
    (f"{HEAD}/lipUpperLeft", 0.27, True),
    (f"{HEAD}/lipCornerLeft", 0.0, True),
    (f"{JAW}/lipLower", 0.5, False),
    (f"{JAW}/lipLowerLeft", 0.27, False),
)


@dataclass(frozen=True)
class Rig:
    """The skeleton, and the head point that each skin joint sits at."""

    skeleton: Skeleton
    seats: dict[str, int]  # joint path -> head point

    def index(self, joint: str) -> int:
        """Position of a joint in the skeleton, by path or last name."""
        return next(i for i, path in enumerate(self.skeleton.joints) if path == joint or path.endswith("/" + joint))


def twin(path: str) -> str:
    """The joint on the other side."""
    return path.replace("Left", "#").replace("Right", "Left").replace("#", "Right")


def build(points: FloatArray, who: Identity) -> Rig:
    """The rig of a head with the given points (n, 3)."""
    top = topology.build()
    seats = {path: int(top.grid[row, column]) for path, column, row in _ON_GRID}
    rings = top.rings["mouth"][mouth.OUTLINE + 2]
    half = len(rings) // 2
    for path, share, upper in _ON_LIPS:
        spoke = round(share * half)
        seats[path] = int(rings[spoke if upper else -spoke])
    seats |= {twin(path): int(top.mirror[point]) for path, point in seats.items() if "Left" in path}
    places = _inner(points, who) | {path: points[point] for path, point in seats.items()}
    joints = _ordered(places)
    world = np.tile(np.eye(4), (len(joints), 1, 1))
    world[:, :3, 3] = [places[joint] for joint in joints]
    skeleton = Skeleton(joints=joints, bind_transforms=world)
    rest = world.copy()
    parents = skeleton.parents
    rest[parents >= 0, :3, 3] -= world[parents[parents >= 0], :3, 3]
    return Rig(Skeleton(joints=joints, bind_transforms=world, rest_transforms=rest), seats)


def _inner(points: FloatArray, who: Identity) -> dict[str, FloatArray]:
    """Joints inside the head."""
    center = eyes.eye(who).center
    lip_line = mouth.lips(who).height
    ear = points[topology.build().rings["earLeft"][1]].mean(axis=0)
    places = {
        "root": np.array([0.0, -16.0, -1.8]),
        "root/neck": np.array([0.0, -12.5, -2.2]),
        HEAD: np.array([0.0, -4.0, -0.8]),
        JAW: HINGE.copy(),
        f"{JAW}/tongue": np.array([0.0, lip_line - 0.9, 4.4]),
        f"{JAW}/tongue/tongueTip": np.array([0.0, lip_line - 0.8, 7.0]),
        f"{HEAD}/earLeft": ear,
        f"{HEAD}/eyeLeft": center,
        f"{HEAD}/lidUpperLeft": center,
        f"{HEAD}/lidLowerLeft": center,
    }
    return places | {twin(path): place * (-1, 1, 1) for path, place in places.items() if "Left" in path}


def _ordered(places: dict[str, FloatArray]) -> tuple[str, ...]:
    """Parents first, siblings by name."""
    return tuple(sorted(places, key=lambda path: path.split("/")))
