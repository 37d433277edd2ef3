"""VRM's human bones: joints by their names, and those that are added."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from command_line import done, exit_code, failed
from facepipe_gltf import read as gltf
from facepipe_gltf import vrm
from facepipe_gltf.vrm.bones import PARENTS, REQUIRED, bones_of, humanoid_of
from faces import grid_mesh, tiny_face
from gltf_export import reference
from vrm_export import (
    TERMS,
    exported,
    extension,
    head,
    read_json,
    seen,
)

from facepipe.core.errors import ExportError, InputError
from facepipe.core.names import identifier
from facepipe.parts import FaceParts, FloatArray, Skeleton, Skin
from facepipe.stage import save_parts


@pytest.mark.parametrize(("up", "turn"), [("Y", 90), ("Z", 180)])
def test_models_look_along_z_and_stand_on_the_ground(up: Literal["Y", "Z"], turn: int, tmp_path: Path) -> None:
    """Whichever way a stage faces, the same model comes out."""
    parts = head()
    matrix = np.eye(4)
    if up == "Z":
        matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    angle = np.radians(turn)
    sideways = np.eye(4)
    sideways[0, 0] = sideways[2, 2] = np.cos(angle)
    sideways[0, 2], sideways[2, 0] = np.sin(angle), -np.sin(angle)
    matrix = matrix @ sideways
    skeleton = replace(parts.skeleton, transform=matrix @ parts.skeleton.transform)
    report = exported(replace(parts, skeleton=skeleton, up_axis=up), tmp_path / "turned.vrm", shapes="")
    exported(parts, tmp_path / "plain.vrm", shapes="")
    turned, plain = (
        reference(gltf.read(tmp_path / name, gltf.Options()).parts) for name in ("turned.vrm", "plain.vrm")
    )
    assert max(np.abs(points - plain[name]).max() for name, points in turned.items()) < 1e-6
    assert any("about the up axis" in line for line in report.added) == (turn != 0)
    findings = vrm.validate(tmp_path / "turned.vrm", khronos=False)
    assert not [finding for finding in findings if finding.check == "facepipe:VrmPose"]


def test_bones_that_are_missing_are_named_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_parts(head(), tmp_path / "head.usda")
    out = tmp_path / "head.vrm"
    terms = ["--license-url", TERMS["license_url"], "--authors", "someone"]
    line = failed(capsys, "export", tmp_path / "head.usda", "-o", out, *terms, folder=tmp_path)
    own = {"head"}  # of the required ones
    assert [bone for bone in REQUIRED if bone in re.findall(r"\w+", line)] == [
        one for one in REQUIRED if one not in own
    ]
    report = done(capsys, "export", tmp_path / "head.usda", "-o", out, "--stub-body", *terms, quiet=False)
    added = next(line for line in report.splitlines() if "move no point" in line)
    assert all(bone in added for bone in REQUIRED if bone not in own)
    assert exit_code("validate", out) == 0


@pytest.mark.parametrize(
    "names",
    [
        "Hips Spine Spine1 Spine2 Neck Head {}Shoulder {}Arm {}ForeArm {}Hand {}UpLeg {}Leg {}Foot {}ToeBase {}Eye",
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head "
        "mixamorig:{}Shoulder mixamorig:{}Arm mixamorig:{}ForeArm mixamorig:{}Hand mixamorig:{}UpLeg mixamorig:{}Leg "
        "mixamorig:{}Foot mixamorig:{}ToeBase mixamorig:{}Eye",
        "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head J_Bip_{L}_Shoulder "
        "J_Bip_{L}_UpperArm J_Bip_{L}_LowerArm J_Bip_{L}_Hand J_Bip_{L}_UpperLeg J_Bip_{L}_LowerLeg J_Bip_{L}_Foot "
        "J_Bip_{L}_ToeBase J_Adj_{L}_FaceEye",
        "pelvis spine_01 spine_02 spine_03 neck_01 head clavicle_{l} upperarm_{l} lowerarm_{l} hand_{l} thigh_{l} "
        "calf_{l} foot_{l} ball_{l} FACIAL_{L}_Eye",
        "DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.006 DEF-shoulder.{L} "
        "DEF-upper_arm.{L} DEF-forearm.{L} DEF-hand.{L} DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} DEF-toe.{L} "
        "DEF-eye.{L}",
        "センター 上半身 上半身2 上半身3 首 頭 {J}肩 {J}腕 {J}ひじ {J}手首 {J}足 {J}ひざ {J}足首 {J}つま先 {J}目",
    ],
    ids=["mixamo", "mixamo namespace", "vroid", "unreal", "rigify", "mmd"],
)
def test_joints_are_known_by_the_names_of_their_convention(names: str) -> None:
    expected = ["hips", "spine", "chest", "upperChest", "neck", "head"]
    parts = ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes", "Eye")
    joints = []
    for side in ("Left", "Right"):
        expected += [f"{side.lower()}{part}" for part in parts]
        japanese = {"Left": "左", "Right": "右"}[side]
        joints += [word.format(side, L=side[0], l=side[0].lower(), J=japanese) for word in names.split()]
    found = bones_of(list(dict.fromkeys(joints)))
    assert set(found) == set(expected)
    assert [found[bone] for bone in expected] == list(range(len(expected)))


def test_bones_of_a_made_up_face_hang_where_vrm_has_them(tmp_path: Path) -> None:
    """Joints without names of any convention hang under a head that is added; --bones names the face's own."""
    parts = tiny_face()
    exported(parts, tmp_path / "stub.vrm")
    exported(parts, tmp_path / "named.vrm", bones="head=root,jaw=root/jaw")
    for name, own in (("stub.vrm", set[str]()), ("named.vrm", {"jaw", "head"})):
        document = read_json(tmp_path / name)
        nodes, bones = document["nodes"], extension(tmp_path / name)["humanoid"]["humanBones"]
        above = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
        human = {one["node"]: bone for bone, one in bones.items()}
        assert len(human) == len(bones)
        assert set(bones) == set(REQUIRED) | own
        for node, bone in human.items():
            while (node := above.get(node, -1)) >= 0 and node not in human:
                pass
            due = PARENTS[bone]
            while due and due not in bones:
                due = PARENTS[due]
            assert human.get(node, "") == due


MIXAMO = {  # a standing body in metres: joint -> parent and place, right sides mirrored
    "mixamorig:Hips": ("", (0, 0.93, 0)),
    "mixamorig:Spine": ("mixamorig:Hips", (0, 1.03, 0)),
    "mixamorig:Neck": ("mixamorig:Spine", (0, 1.42, 0)),
    "mixamorig:Head": ("mixamorig:Neck", (0, 1.52, 0)),
    "mixamorig:{}Arm": ("mixamorig:Spine", (0.2, 1.38, 0)),
    "mixamorig:{}ForeArm": ("mixamorig:{}Arm", (0.5, 1.38, 0)),
    "mixamorig:{}Hand": ("mixamorig:{}ForeArm", (0.75, 1.38, 0)),
    "mixamorig:{}UpLeg": ("mixamorig:Hips", (0.1, 0.93, 0)),
    "mixamorig:{}Leg": ("mixamorig:{}UpLeg", (0.1, 0.5, 0)),
    "mixamorig:{}Foot": ("mixamorig:{}Leg", (0.1, 0.07, 0)),
}


def standing(without: str = "") -> FaceParts:
    """A face on a body with Mixamo's names, which stage paths can't hold; children of a joint left out rise."""
    joints: dict[str, tuple[str, FloatArray]] = {}
    for name, (parent, place) in MIXAMO.items():
        for side, sign in (("Left", 1), ("Right", -1)) if "{}" in name else (("", 1),):
            joints[name.format(side)] = (parent.format(side), np.array(place) * (sign, 1, 1))
    gone = joints.pop(f"mixamorig:{without}", None)
    own = {name: (gone[0] if gone and name and name not in joints else name) for name, _ in joints.values()}
    places = {name: place for name, (_, place) in joints.items()}
    paths: dict[str, str] = {}
    for name, (parent, _) in joints.items():
        above = paths.get(own[parent], "")
        paths[name] = f"{above}/{identifier(name)}".lstrip("/")
    bind = np.tile(np.eye(4), (len(joints), 1, 1))
    bind[:, :3, 3] = list(places.values())
    rest = bind.copy()
    rest[:, :3, 3] -= [places.get(own[parent], np.zeros(3)) for parent, _ in joints.values()]
    skeleton = Skeleton(
        joints=tuple(paths.values()), joint_names=tuple(paths), bind_transforms=bind, rest_transforms=rest
    )
    mesh = grid_mesh()
    weights = np.ones((len(mesh.points), 1), np.float32)
    skin = Skin(
        joint_indices=np.full(
            weights.shape, [*paths].index("mixamorig:Neck" if without == "Head" else "mixamorig:Head")
        ),
        joint_weights=weights,
    )
    mesh = replace(mesh, points=mesh.points * 0.05 + (0, 1.5, 0.1), skin=skin)
    return FaceParts(name="Person", meters_per_unit=1.0, meshes=(mesh,), skeleton=skeleton)


def test_a_whole_body_is_taken_as_it_is(tmp_path: Path) -> None:
    parts = standing()
    report = exported(parts, tmp_path / "whole.vrm", stub_body=False)
    assert not report.added
    bones = extension(tmp_path / "whole.vrm")["humanoid"]["humanBones"]
    nodes = read_json(tmp_path / "whole.vrm")["nodes"]
    assert set(bones) == {*REQUIRED, "neck"}
    assert nodes[bones["leftLowerArm"]["node"]]["name"] == "mixamorig:LeftForeArm"
    assert not [one for one in vrm.validate(tmp_path / "whole.vrm", khronos=False) if one.severity != "info"]


@pytest.mark.parametrize(
    "without", ["Spine", "LeftFoot", *(pytest.param(one, marks=pytest.mark.slow) for one in ("Hips", "RightHand"))]
)
def test_a_bone_that_alone_is_missing_is_put_between_the_others(without: str, tmp_path: Path) -> None:
    parts = standing(without)
    with pytest.raises(InputError, match="1 of the 15"):
        exported(parts, tmp_path / "part.vrm", stub_body=False)
    exported(parts, tmp_path / "part.vrm")
    assert not [one for one in vrm.validate(tmp_path / "part.vrm", khronos=False) if one.severity != "info"]
    answer, (found,) = seen(tmp_path / "part.vrm", parts, [{}])
    apart = found - parts.meshes[0].points
    assert np.ptp(apart, axis=0).max() < 1e-6
    whole = {"Hips": "hips", "Spine": "spine", "LeftFoot": "leftFoot", "RightHand": "rightHand"}[without]
    assert np.linalg.norm(np.subtract(answer["bones"][whole], apart[0]) - dict(place_of())[without]) < 0.1


def test_joints_that_hang_elsewhere_than_their_bones_are_none_of_them() -> None:
    parts = tiny_face()
    beside = replace(parts, skeleton=replace(parts.skeleton, joints=("Neck", "Neck/Head", "Neck/Jaw")))
    found = humanoid_of(beside, "")
    assert found.bones == {"neck": 0, "head": 1}
    assert found.unfit == ("Neck/Jaw is not the jaw: it hangs elsewhere in the tree than VRM requires",)


def test_scales_that_vrm_does_not_have_are_named(tmp_path: Path) -> None:
    parts = standing()
    rest = np.array(parts.skeleton.rest_transforms)
    rest[parts.skeleton.names.index("mixamorig:LeftHand"), 1, 1] = 1.5
    uneven = replace(parts, skeleton=replace(parts.skeleton, rest_transforms=rest))
    report = exported(uneven, tmp_path / "head.vrm", stub_body=False)
    assert [line for line in report.warnings if line.startswith("mixamorig:LeftHand: scaled unevenly")]
    findings = vrm.validate(tmp_path / "head.vrm", khronos=False)
    assert [finding.check for finding in findings if finding.severity != "info"] == ["facepipe:VrmScales"]


@pytest.mark.parametrize("without", ["Head", "LeftForeArm"])
def test_a_bone_that_cannot_be_made_up_is_asked_for(without: str, tmp_path: Path) -> None:
    """Where joints of the face's own would hang wrong."""
    with pytest.raises((InputError, ExportError), match="option bones"):
        exported(standing(without), tmp_path / "part.vrm")
    assert not [*tmp_path.iterdir()]


def place_of() -> Iterator[tuple[str, FloatArray]]:
    """Joints of `MIXAMO` without prefix, and their places."""
    for name, (_, place) in MIXAMO.items():
        for side, sign in (("Left", 1), ("Right", -1)):
            yield name.removeprefix("mixamorig:").format(side), np.array(place) * (sign, 1, 1)
