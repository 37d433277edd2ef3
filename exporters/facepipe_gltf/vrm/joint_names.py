"""Which joints are human bones, by their names."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.parts import Skeleton
from facepipe_gltf.vrm.bones import PARENTS, SIDES

_TABLE = Path(__file__).with_name("joint_names.toml")
_BREAKS = re.compile(r"[^A-Za-z0-9]+|(?<=[a-z0-9])(?=[A-Z])")
_PREFIX = re.compile(r"mixamorig\d*|j|bip|adj|def|org|facial|c")
_FEWEST = 3
_ROOT = "root"
_SIDE = {"l": "left", "left": "left", "r": "right", "right": "right"}


def reduced(name: str) -> tuple[str, str]:
    """The side (left, right or none) of a joint's name, and its words without case, separators and prefixes.

    >>> reduced("mixamorig:LeftForeArm"), reduced("J_Bip_C_UpperChest"), reduced("DEF-spine.001")
    (('left', 'forearm'), ('', 'upperchest'), ('', 'spine001'))
    """
    words = [word.lower() for word in _BREAKS.split(name) if word]
    sides = [_SIDE[word] for word in words if word in _SIDE]
    rest = [word for word in words if word not in _SIDE and not _PREFIX.fullmatch(word)]
    return sides[0] if sides else "", "".join(rest)


def bones_of(joints: Sequence[str]) -> dict[str, int]:
    """Human bone -> number among the names of joints, by the convention that knows most of them; the first of several.

    One that knows neither three names nor the head is none; neither is a root the hips that no spine hangs below: rigs
    of heads have one too.
    """
    found: dict[str, int] = {}
    numbers: dict[tuple[str, str], int] = {}
    for i, joint in enumerate(joints):
        numbers.setdefault(reduced(joint), i)
    for names in _conventions():
        known = {bone: numbers[name] for bone, every in names.items() for name in every if name in numbers}
        if "spine" not in known and "hips" in known and reduced(joints[known["hips"]])[1] == _ROOT:
            del known["hips"]
        if len(known) > len(found) and (len(known) >= _FEWEST or "head" in known):
            found = known
    return found


def given_bones(text: str, skeleton: Skeleton) -> dict[str, int]:
    """Human bone -> number of the joint of ``BONE=JOINT,...``; a joint is its path or its name.

    :raises InputError: no such bone or joint, or one of them twice
    """
    found: dict[str, int] = {}
    for pair in filter(None, (one.strip() for one in text.split(","))):
        bone, equals, joint = (part.strip() for part in pair.partition("="))
        where = f"option bones -> {pair}"
        if not equals:
            raise InputError(where, "expected BONE=JOINT")
        if bone not in PARENTS:
            known = did_you_mean(bone, PARENTS) or ", expected one like hips, spine, head, jaw, leftEye"
            raise InputError(where, f"'{bone}' is no human bone of VRM{known}")
        pairs = zip(skeleton.joints, skeleton.names, strict=True)
        places = [i for i, names in enumerate(pairs) if joint in names]
        if not places:
            near = did_you_mean(joint, skeleton.names) or f", expected one of {len(skeleton.joints)}"
            raise InputError(where, f"no joint called '{joint}'{near}")
        if len(places) > 1:
            raise InputError(where, f"{len(places)} joints called '{joint}', expected a path")
        if bone in found or places[0] in found.values():
            raise InputError(where, "a bone or joint twice, expected each once")
        found[bone] = places[0]
    return found


@cache
def _conventions() -> tuple[Mapping[str, Sequence[tuple[str, str]]], ...]:
    """Of each convention: human bone -> the names it may have, reduced; the last counts most."""
    tables = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
    return tuple(
        {
            bone: [(side, word) for word in reversed(words)]
            for key, words in table.items()
            for bone, side in ([(key, "")] if key in PARENTS else [(side + key, side) for side in SIDES])
        }
        for table in tables.values()
    )
