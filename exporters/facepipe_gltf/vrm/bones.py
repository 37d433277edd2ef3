"""The human bones of VRM 1.0: the tree that a model must have, and which joints of a face they are.

Source: VRMC_vrm-1.0, humanoid.md (vrm-c/vrm-specification).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.parts import FaceParts, Skeleton
from facepipe_gltf.raw import path_above

_FINGERS = {
    "Thumb": ("Metacarpal", "Proximal", "Distal"),
    **dict.fromkeys(("Index", "Middle", "Ring", "Little"), ("Proximal", "Intermediate", "Distal")),
}
SIDES = ("left", "right")
TORSO = ("hips", "spine", "chest", "upperChest", "neck", "head")
REQUIRED = (
    *("hips", "spine", "head"),
    *(f"{side}{part}" for side in SIDES for part in ("UpperLeg", "LowerLeg", "Foot")),
    *(f"{side}{part}" for side in SIDES for part in ("UpperArm", "LowerArm", "Hand")),
)
_LIMBS = {  # of one side: part -> the part, or bone of the middle, that it hangs below
    "UpperLeg": "hips",
    "LowerLeg": "UpperLeg",
    "Foot": "LowerLeg",
    "Toes": "Foot",
    "Shoulder": "upperChest",
    "UpperArm": "Shoulder",
    "LowerArm": "UpperArm",
    "Hand": "LowerArm",
    **{
        f"{finger}{link}": f"{finger}{above}" if above else "Hand"
        for finger, links in _FINGERS.items()
        for above, link in zip(("", *links), links, strict=False)
    },
}
PARENTS = {  # bone -> the bone that it hangs below where the model has it; the topmost has none
    "hips": "",
    "spine": "hips",
    "chest": "spine",
    "upperChest": "chest",
    "neck": "upperChest",
    "head": "neck",
    "leftEye": "head",
    "rightEye": "head",
    "jaw": "head",
    **{
        f"{side}{part}": f"{side}{above}" if above in _LIMBS else above
        for side in SIDES
        for part, above in _LIMBS.items()
    },
}
_NEEDS_PARENT = frozenset(  # exist only where the bone above them does
    ["upperChest"]
    + [f"{side}{finger}{link}" for side in SIDES for finger, links in _FINGERS.items() for link in links[1:]]
)
_TABLE = Path(__file__).with_name("joint_names.toml")
_BREAKS = re.compile(r"[\W_]+|(?<=[a-z0-9])(?=[A-Z])|(?<=[左右])|(?=[左右])")
_PREFIX = re.compile(r"mixamorig\d*|j|bip|adj|def|org|facial|c")
_FEWEST = 3
_ROOT = "root"
_SIDE = {"l": "left", "left": "left", "左": "left", "r": "right", "right": "right", "右": "right"}


def above(bone: str, present: Container[str]) -> str | None:
    """The bone among `present` that `bone` hangs below; None where there is none."""
    parent = PARENTS[bone]
    while parent and parent not in present:
        parent = PARENTS[parent]
    return parent or None


class Misplaced(NamedTuple):
    """A human bone that does not hang below the one that it should."""

    bone: str
    expected: str | None
    found: str | None


def misplaced(bones: Mapping[str, int], path: Callable[[int], list[int]]) -> Misplaced | None:
    """The first of `bones` (bone -> node or joint) that hangs elsewhere; other nodes may stand between.

    :param path: a node and all above it, the root last
    """
    of_node = {node: bone for bone, node in bones.items()}
    for bone in PARENTS:
        if bone in bones:
            expected = above(bone, bones)
            found = next((of_node[one] for one in path(bones[bone])[1:] if one in of_node), None)
            if found != expected or (bone in _NEEDS_PARENT and found != PARENTS[bone]):
                return Misplaced(bone, expected, found)
    return None


def _reduced(name: str) -> tuple[str, str]:
    """The side (left, right or none) of a joint's name, and its words without case, separators and prefixes.

    >>> _reduced("mixamorig:LeftForeArm"), _reduced("J_Bip_C_UpperChest"), _reduced("DEF-spine.001")
    (('left', 'forearm'), ('', 'upperchest'), ('', 'spine001'))
    """
    words = [word.lower() for word in _BREAKS.split(name) if word]
    sides = [_SIDE[word] for word in words if word in _SIDE]
    rest = [word for word in words if word not in _SIDE and not _PREFIX.fullmatch(word)]
    return sides[0] if sides else "", "".join(rest)


def bones_of(joints: Sequence[str]) -> dict[str, int]:
    """Human bone -> number among the names of joints, by the convention that knows most of them; the first of several.

    A convention that knows neither three names nor the head doesn't count. A joint called root without a spine below
    it is not the hips: rigs of heads have one too.
    """
    bones: dict[str, int] = {}
    numbers: dict[tuple[str, str], int] = {}
    for i, joint in enumerate(joints):
        numbers.setdefault(_reduced(joint), i)
    for names in _conventions():
        known = {bone: numbers[name] for bone, every in names.items() for name in every if name in numbers}
        if "spine" not in known and "hips" in known and _reduced(joints[known["hips"]])[1] == _ROOT:
            del known["hips"]
        if len(known) > len(bones) and (len(known) >= _FEWEST or "head" in known):
            bones = known
    return bones


def _given_bones(text: str, skeleton: Skeleton) -> dict[str, int]:
    """Human bone -> number of the joint of ``BONE=JOINT,...``; a joint is its path or its name.

    :raises InputError: no such bone or joint, or one of them twice
    """
    given: dict[str, int] = {}
    for pair in filter(None, (one.strip() for one in text.split(","))):
        bone, equals, joint = (part.strip() for part in pair.partition("="))
        where = f"option bones -> {pair}"
        if not equals:
            raise InputError(where, "expected BONE=JOINT")
        if bone not in PARENTS:
            known = did_you_mean(bone, PARENTS) or ", expected one like hips, spine, head, jaw, leftEye"
            raise InputError(where, f"'{bone}' is no human bone of VRM{known}")
        # paths are distinct, names need not be
        pairs = zip(skeleton.joints, skeleton.names, strict=True)
        places = [i for i, names in enumerate(pairs) if joint in names]
        if not places:
            near = did_you_mean(joint, skeleton.names) or f", expected one of {len(skeleton.joints)}"
            raise InputError(where, f"no joint called '{joint}'{near}")
        if len(places) > 1:
            raise InputError(where, f"{len(places)} joints called '{joint}', expected a path")
        if bone in given or places[0] in given.values():
            raise InputError(where, "a bone or joint twice, expected each once")
        given[bone] = places[0]
    return given


@cache
def _conventions() -> tuple[Mapping[str, Sequence[tuple[str, str]]], ...]:
    """For each convention: human bone -> its possible names, reduced; the last takes precedence."""
    tables = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    return tuple(
        {
            bone: [(side, word) for word in reversed(words)]
            for key, words in table.items()
            for bone, side in ([(key, "")] if key in PARENTS else [(side + key, side) for side in SIDES])
        }
        for table in tables.values()
    )


@dataclass(frozen=True)
class Humanoid:
    """The human bones among a face's joints."""

    bones: dict[str, int]  # bone -> number of the joint
    unfit: tuple[str, ...]  # joints with the name of a bone that they can't be, a line each


def humanoid_of(parts: FaceParts, given: str, kept: Mapping[str, int] | None = None) -> Humanoid:
    """The human bones of a face, by the names of its joints and those `given` (``BONE=JOINT,...``).

    A face that no mesh is skinned to has none: its joints are not in the file.

    :param kept: bones that the face came with (to numbers of joints), which count instead of names
    :raises InputError: a bone or joint that isn't there, or a required bone below another than VRM has it
    """
    joints = parts.skeleton.joints
    wanted = _given_bones(given, parts.skeleton)
    if not any(mesh.skin is not None and len(mesh.face_vertex_counts) for mesh in parts.meshes):
        if wanted:
            raise InputError("option bones", "no mesh is skinned to the face's joints, expected none")
        if kept:
            raise InputError(parts.name, "no mesh is skinned to the human bones of its VRM, expected one")
        return Humanoid({}, ())
    own = bones_of(parts.skeleton.names) if kept is None else kept
    named = {bone: joint for bone, joint in own.items() if joint not in wanted.values()}
    bones = named | wanted
    above = {joint: int(parent) for joint, parent in enumerate(parts.skeleton.parents) if parent >= 0}
    unfit = []
    while wrong := misplaced(bones, lambda joint: path_above(joint, above.get)):
        # a bone found by name gives way; one that VRM requires or the user named never does
        drop = next((one for one in (wrong.expected, wrong.bone) if one and one not in REQUIRED), None)
        below = f"below the {wrong.found}" if wrong.found else "below no human bone"
        due = f"below the {wrong.expected or PARENTS[wrong.bone]}"
        if drop is None or drop in wanted:
            where = f"{parts.name} -> {joints[bones[wrong.bone]]}"
            raise InputError(where, f"is the {wrong.bone}, {below}, expected {due} (option bones names other joints)")
        unfit.append(f"{joints[bones[drop]]} is not the {drop}: it hangs elsewhere in the tree than VRM requires")
        del bones[drop]
    if "head" not in bones and (torso := [bone for bone in bones if bone in TORSO]):
        problem = (
            f"no joint is named like a head, but {', '.join(torso)} are there, expected head=JOINT in option bones"
        )
        raise InputError(f"{parts.name} -> {parts.skeleton.name}", problem)
    return Humanoid(bones, tuple(unfit))
