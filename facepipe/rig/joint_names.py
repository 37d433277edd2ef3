"""Which joint is the head, an eye, the jaw or the hips, by the names that programs give them."""

from __future__ import annotations

import re
from collections.abc import Mapping

from facepipe.parts import FaceParts, Skeleton
from facepipe.rig.conventions import shape_key

_NAMES = {  # as `shape_key` has them
    "Head": ("head", "頭"),
    "LeftEye": ("eyeleft", "eyeballleft", "eyejntleft", "eyejointleft", "左目"),
    "RightEye": ("eyeright", "eyeballright", "eyejntright", "eyejointright", "右目"),
    "Hips": ("hips", "hip", "pelvis", "下半身"),
    "Jaw": ("jaw", "jawroot", "jawmaster", "lowerjaw", "あご", "顎"),
}
_PREFIX = re.compile(r"^(mixamorig\d*|j_bip_c|bip\d*|def|org|cc_base|c|facial|face)[:_\- ]+", re.IGNORECASE)


def human_joint(parts: FaceParts, part: str) -> int | None:
    """The joint of a part of an avatar, as its VRM says, else as `joint_called`; None where there is none."""
    found: object = parts.vrm
    for key in ("VRMC_vrm", "humanoid", "humanBones", f"{part[:1].lower()}{part[1:]}", "node"):
        found = found.get(key) if isinstance(found, Mapping) else None
    joints = parts.skeleton.joints
    return joints.index(found) if isinstance(found, str) and found in joints else joint_called(parts.skeleton, part)


def joint_called(skeleton: Skeleton, part: str) -> int | None:
    """The joint of a part with a usual name, that nearest to the root; None where there is none.

    :param part: Head, LeftEye, RightEye, Hips or Jaw
    """
    names = [{joint.rpartition("/")[2], own} for joint, own in zip(skeleton.joints, skeleton.names, strict=True)]
    found = [i for i, one in enumerate(names) if {joint_key(name) for name in one} & {*_NAMES[part]}]
    # nearest to the root: what hangs below a head or eye and is called as it helps to move it
    return min(found, key=lambda i: (skeleton.joints[i].count("/"), i), default=None)


def joint_key(name: str) -> str:
    """`name` as `shape_key` has it, without namespace and the prefixes of programs: ``mixamorig:Head`` is ``head``."""
    return shape_key(_PREFIX.sub("", name.rpartition("|")[2]).rpartition(":")[2])
