"""The human bones of VRM 1.0: which a model must have, and which hangs below which.

Source: VRMC_vrm-1.0, humanoid.md (vrm-c/vrm-specification).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import NamedTuple

_FINGERS = {
    "Thumb": ("Metacarpal", "Proximal", "Distal"),
    **dict.fromkeys(("Index", "Middle", "Ring", "Little"), ("Proximal", "Intermediate", "Distal")),
}
SIDES = ("left", "right")


def _parents() -> dict[str, str]:
    """Bone -> the bone that it hangs below where the model has it; the topmost has none."""
    parents = {"hips": "", "spine": "hips", "chest": "spine", "upperChest": "chest", "neck": "upperChest"}
    parents |= {"head": "neck", "leftEye": "head", "rightEye": "head", "jaw": "head"}
    for side in SIDES:
        parents |= {f"{side}UpperLeg": "hips", f"{side}LowerLeg": f"{side}UpperLeg"}
        parents |= {f"{side}Foot": f"{side}LowerLeg", f"{side}Toes": f"{side}Foot"}
        parents |= {f"{side}Shoulder": "upperChest", f"{side}UpperArm": f"{side}Shoulder"}
        parents |= {f"{side}LowerArm": f"{side}UpperArm", f"{side}Hand": f"{side}LowerArm"}
        for finger, links in _FINGERS.items():
            above = f"{side}Hand"
            for link in links:
                parents[f"{side}{finger}{link}"] = above
                above = f"{side}{finger}{link}"
    return parents


PARENTS = _parents()
TORSO = ("hips", "spine", "chest", "upperChest", "neck", "head")
REQUIRED = (
    *("hips", "spine", "head"),
    *(f"{side}{part}" for side in SIDES for part in ("UpperLeg", "LowerLeg", "Foot")),
    *(f"{side}{part}" for side in SIDES for part in ("UpperArm", "LowerArm", "Hand")),
)
NEEDS_PARENT = frozenset(  # exist only where the bone above them does
    ["upperChest"]
    + [f"{side}{finger}{link}" for side in SIDES for finger, links in _FINGERS.items() for link in links[1:]]
)


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
            if found != expected or (bone in NEEDS_PARENT and found != PARENTS[bone]):
                return Misplaced(bone, expected, found)
    return None
