"""The human bones that a face lacks, as nodes that move no point: a body stands below the head, arms held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe_gltf.vrm.bones import REQUIRED, SIDES, TORSO
from facepipe_gltf.vrm.figure import HIPS, Figure
from facepipe_gltf.vrm.nodes import NodeTree

# Parts of a person's height, of the same source as those in figure.py
_SPINE, _SHOULDER, _SKULL = 0.58, 0.818, 0.905
_KNEE, _ANKLE = 0.285, 0.039
_SHOULDER_OUT, _UPPER_ARM, _FOREARM = 0.129, 0.186, 0.146
_LEG_OUT = 0.055


def missing_bones(present: Sequence[str]) -> tuple[str, ...]:
    """The required bones that are not there, in the specification's order."""
    return tuple(bone for bone in REQUIRED if bone not in present)


def standing_place(figure: Figure, hips: int | None) -> FloatArray:
    """(3,) by which the face moves so that a body on the ground holds it; sideways only where the body is all new."""
    if hips is not None:
        return np.array([0.0, HIPS * figure.height - figure.joints[hips, 1], 0.0])
    return np.array([-figure.middle[0], figure.height - figure.high[1], -figure.middle[2]])


def add_body(tree: NodeTree, bones: dict[str, int], figure: Figure, roots: Sequence[int]) -> None:
    """Add what is missing of the required human bones.

    :param bones: human bone -> node; grows
    :param figure: measures of the face where it stands now
    :param roots: nodes of the skeleton at the scene's root
    """
    own = [bone for bone in TORSO if bone in bones]
    if "hips" not in bones:
        root = tree.add("root", np.zeros(3), None)
        legs = [tree.world(bones[f"{side}UpperLeg"])[:3, 3] for side in SIDES if f"{side}UpperLeg" in bones]
        bones["hips"] = tree.add("hips", np.mean(legs, axis=0) if len(legs) == 2 else _at(figure, HIPS), root)
    if "spine" not in bones:
        _add_spine(tree, bones, figure, own)
    elif "hips" not in own:
        tree.hang(tree.path(bones["spine"])[-1], bones["hips"])
    if "head" not in bones:
        bones["head"] = tree.add("head", _at(figure, _SKULL), bones["spine"])
        for root in roots:
            tree.hang(root, bones["head"])
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        _add_leg(tree, bones, figure, side, sign)
        _add_arm(tree, bones, figure, side, sign)


def _add_spine(tree: NodeTree, bones: dict[str, int], figure: Figure, own: Sequence[str]) -> None:
    """A spine above the hips, and what hangs there now above the spine."""
    next_up = next((bone for bone in own if bone != "hips"), None)
    if "hips" not in own:
        bones["spine"] = tree.add("spine", _at(figure, _SPINE), bones["hips"])
        if next_up is not None:
            tree.hang(tree.path(bones[next_up])[-1], bones["spine"])
        return
    low = tree.world(bones["hips"])[:3, 3]
    up = _at(figure, _SKULL) if next_up is None else tree.world(bones[next_up])[:3, 3]
    part = (_SPINE - HIPS) / (_SKULL - HIPS)
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
    for bone, above, part in ((lower, upper, _KNEE / HIPS), (foot, lower, _ANKLE / _KNEE)):
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
