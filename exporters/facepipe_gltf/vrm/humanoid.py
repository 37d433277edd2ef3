"""Which joints of a face are VRM's human bones, held to the rules of their tree."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.core.arrays import IntArray
from facepipe.core.errors import InputError
from facepipe.parts import FaceParts
from facepipe_gltf.vrm.bones import PARENTS, REQUIRED, TORSO, misplaced
from facepipe_gltf.vrm.joint_names import bones_of, given_bones


@dataclass(frozen=True)
class Humanoid:
    """The human bones among a face's joints."""

    bones: dict[str, int]  # bone -> number of the joint
    unfit: tuple[str, ...]  # joints with the name of a bone that they can't be, a line each


def humanoid_of(parts: FaceParts, given: str) -> Humanoid:
    """The human bones of a face, by the names of its joints and those `given` (``BONE=JOINT,...``).

    A face that no mesh is skinned to has none: its joints are not in the file.

    :raises InputError: a bone or joint that isn't there, or a required bone below another than VRM has it
    """
    joints = parts.skeleton.joints
    wanted = given_bones(given, parts.skeleton)
    if not any(mesh.skin is not None and len(mesh.face_vertex_counts) for mesh in parts.meshes):
        if wanted:
            raise InputError("option bones", "no mesh is skinned to the face's joints, expected none")
        return Humanoid({}, ())
    named = {bone: joint for bone, joint in bones_of(parts.skeleton.names).items() if joint not in wanted.values()}
    bones = named | wanted
    parents = parts.skeleton.parents
    unfit = []
    while wrong := misplaced(bones, lambda joint: _path(joint, parents)):
        drop = next((one for one in (wrong.expected, wrong.bone) if one and one not in REQUIRED), None)
        below = f"below the {wrong.found}" if wrong.found else "below no human bone"
        due = f"below the {wrong.expected or PARENTS[wrong.bone]}"
        if drop is None or drop in wanted:
            where = f"{parts.name} -> {joints[bones[wrong.bone]]}"
            raise InputError(where, f"is the {wrong.bone}, {below}, expected {due} (option bones names other joints)")
        unfit.append(f"{joints[bones[drop]]} is no {drop}: its place in the tree is not the one that VRM has for it")
        del bones[drop]
    _check_head(parts, bones)
    return Humanoid(bones, tuple(unfit))


def _check_head(parts: FaceParts, bones: dict[str, int]) -> None:
    """:raises InputError: a body below a head that no name gives: turning it would turn nothing"""
    if "head" not in bones and (own := [bone for bone in bones if bone in TORSO]):
        what = (
            f"no joint is the head by its name, though {', '.join(own)} are there, expected head=JOINT in option bones"
        )
        raise InputError(f"{parts.name} -> {parts.skeleton.name}", what)


def _path(joint: int, parents: IntArray) -> list[int]:
    path = [joint]
    while parents[path[-1]] >= 0:
        path.append(int(parents[path[-1]]))
    return path
