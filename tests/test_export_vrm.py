"""VRM 1.0: what three-vrm makes of a file, and what no file is made of."""

from __future__ import annotations

import json
import re
import struct
import tempfile
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from facepipe_gltf import vrm
from facepipe_gltf.vrm.bones import PARENTS, REQUIRED
from facepipe_gltf.vrm.expressions import table
from facepipe_gltf.vrm.joint_names import bones_of
from faces import tiny_face
from gltf_export import TOLERANCE, head_height, reference
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import shared
from node import validate
from vrm_export import (
    BLINKS,
    EMOTIONS,
    HEAD_TURN,
    LOOKS,
    TERMS,
    VOWELS,
    evaluated,
    exported,
    four,
    rotation,
    seen,
)

from facepipe import sample
from facepipe.cli import main
from facepipe.errors import InputError
from facepipe.importers import gltf, load
from facepipe.parts import FaceParts, FloatArray, Landmarks, Slider
from facepipe.rig import build, slide
from facepipe.rig.arkit import ARKIT_SHAPES
from facepipe.stage import save_parts

PRESETS = (*EMOTIONS, *VOWELS, *BLINKS, *LOOKS)


@cache
def head() -> FaceParts:
    """The sample."""
    return sample.make()


def weights_of(parts: FaceParts, preset: str) -> dict[str, float]:
    """A preset as weights of the face's shapes, by the table alone."""
    shapes = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes}
    found = {}
    for name, weight in table()["preset"][preset].items():
        found |= dict.fromkeys([name] if name in shapes else [f"{name}Left", f"{name}Right"], weight)
    return found


def off(found: FloatArray, expected: FloatArray, parts: FaceParts) -> float:
    """Largest distance of a vertex from its point, in head heights."""
    used = np.isfinite(found).all(axis=1)
    assert used.sum() > 0.9 * len(used)
    return float(np.linalg.norm(found[used] - expected[used], axis=1).max()) / head_height(parts)


def check_motion(parts: FaceParts, path: Path, presets: Sequence[str], shapes: Sequence[str], joint: str | None) -> Any:
    """Everything that three-vrm sets moves the vertices as the rig moves the points."""
    exported(parts, path)
    poses: list[dict[str, Any]] = [{}, {"bones": {"head": HEAD_TURN}}]
    poses += [{"expressions": {name: 1.0}} for name in (*presets, *shapes)]
    first = (*shapes, *presets)[0] if shapes or presets else None
    both = {"expressions": {first: 0.7} if first else {}, "bones": {"head": HEAD_TURN}}
    answer, found = seen(path, parts, [*poses, both])
    rest = evaluated(parts, {})
    place = (found[0] - rest)[np.isfinite(found[0]).all(axis=1)].mean(axis=0)
    assert off(found[0], rest + place, parts) < TOLERANCE
    for name, points in zip((*presets, *shapes), found[2:], strict=False):
        weights = weights_of(parts, name) if name in presets else {name: 1.0}
        assert off(points, evaluated(parts, weights) + place, parts) < TOLERANCE, name
    weight = {shapes[0]: 0.7} if shapes else {one: 0.7 * x for one, x in weights_of(parts, presets[0]).items()}
    for weights, points in (({}, found[1]), (weight, found[-1])):
        if joint is not None:
            assert off(points, evaluated(parts, weights, joint, HEAD_TURN) + place, parts) < TOLERANCE
        else:
            pivot = np.array(answer["bones"]["head"])
            turned = (evaluated(parts, weights) + place - pivot) @ rotation(HEAD_TURN).T + pivot
            assert off(points, turned, parts) < TOLERANCE
    return answer


def test_three_vrm_moves_the_sample_as_the_rig_does(tmp_path: Path) -> None:
    parts = head()
    answer = check_motion(parts, tmp_path / "head.vrm", ["happy", "blink"], ["jawOpen"], "root/neck/head")
    assert {*PRESETS, "neutral"} <= {*answer["expressions"]}
    assert {*ARKIT_SHAPES} & {shape.name for shape in parts.meshes[0].blendshapes} <= {*answer["expressions"]}
    assert {*REQUIRED, "neck", "jaw", "leftEye", "rightEye"} == {*answer["bones"]}
    assert answer["meta"]["authors"] == ["someone"]


def test_eyes_of_the_sample_look_at_what_is_within_their_reach(tmp_path: Path) -> None:
    """Each eye turns by the angles at which the point between both sees the target."""
    parts = head()
    exported(parts, tmp_path / "head.vrm")
    answer, _ = seen(tmp_path / "head.vrm", parts, [])
    between = np.mean([answer["bones"][eye] for eye in ("leftEye", "rightEye")], axis=0)
    assert np.allclose(np.add(answer["bones"]["head"], answer["lookAt"]["offset"]), between, atol=1e-6)
    targets = ([0.3, 0.2, 1.0], [-0.4, -0.3, 1.2], [0.0, 0.0, 2.0], [3.0, 0.0, 1.0], [0.0, 9.0, 9.0])
    answer, _ = seen(tmp_path / "head.vrm", parts, [{"lookAt": (between + one).tolist()} for one in targets])
    for (x, y, z), pose in zip(targets, answer["poses"], strict=True):
        for turn in pose["eyes"].values():
            forward = rotation(turn) @ [0.0, 0.0, 1.0]
            yaw = np.degrees(np.arctan2(forward[0], forward[2]))
            assert yaw == pytest.approx(np.clip(np.degrees(np.arctan2(x, z)), -28, 28), abs=1e-3)
            pitch = np.degrees(np.arctan2(y, np.hypot(x, z)))
            assert np.degrees(np.arcsin(forward[1])) == pytest.approx(np.clip(pitch, -14, 14), abs=1e-3)


@pytest.mark.parametrize(("up", "turn"), [("Z", 0), ("Y", 90), ("Y", 180), ("Z", 270)])
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
    assert not [one for one in findings if one.check == "facepipe:VrmPose"]


def test_bones_that_are_missing_are_named_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_parts(head(), tmp_path / "head.usda")
    out = tmp_path / "head.vrm"
    terms = ["--license-url", TERMS["license_url"], "--authors", "someone"]
    assert main(["export", str(tmp_path / "head.usda"), "-o", str(out), *terms]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    own = {"head"}  # of the required ones
    assert [bone for bone in REQUIRED if bone in re.findall(r"\w+", line)] == [
        one for one in REQUIRED if one not in own
    ]
    assert not out.exists()
    assert main(["export", str(tmp_path / "head.usda"), "-o", str(out), "--stub-body", *terms]) == 0
    added = next(line for line in capsys.readouterr().out.splitlines() if "move no point" in line)
    assert all(bone in added for bone in REQUIRED if bone not in own)
    assert main(["validate", str(out)]) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"license_url": ""}, "license_url: not given"),
        ({"license_url": "https://example.org/mine"}, "expected https://vrm.dev/licenses/1.0/"),
        ({"authors": " , "}, "authors: not given"),
        ({"bones": "tail=root"}, "'tail' is no human bone"),
        ({"bones": "hips"}, "expected BONE=JOINT"),
        ({"bones": "hips=pelvis"}, "no joint called 'pelvis'"),
        ({"bones": "neck=neck,chest=neck"}, "expected each once"),
        ({"bones": "spine=root/neck/head/jaw"}, "jaw: is the spine, below the head"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        exported(head(), tmp_path / "head.vrm", **change)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "no JSON object"),
        ('{"name": ', "no readable JSON"),
        ('{"comercialUsage": "corporation"}', "did you mean 'commercialUsage'"),
        ('{"commercialUsage": "always"}', "expected personalNonProfit or personalProfit or corporation"),
        ('{"allowRedistribution": "yes"}', "expected true or false"),
        ('{"authors": []}', "expected a list of texts"),
        ('{"thumbnailImage": 0}', "thumbnailImage"),
    ],
)
def test_meta_that_vrm_does_not_have_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text(text)
    with pytest.raises(InputError, match=words):
        exported(head(), tmp_path / "head.vrm", authors="", meta=tmp_path / "meta.json")
    assert not (tmp_path / "head.vrm").exists()


def test_meta_comes_from_options_their_file_and_the_attribution(tmp_path: Path) -> None:
    parts = replace(tiny_face(), attribution="Someone Else, CC0 1.0")
    (tmp_path / "meta.json").write_text(
        '{"version": "7", "licenseUrl": "https://vrm.dev/licenses/1.0/", "name": "Ann"}'
    )
    exported(parts, tmp_path / "one.vrm", authors="", license_url="", meta=tmp_path / "meta.json")
    exported(parts, tmp_path / "two.vrm", authors="Me, You")
    one, two = (extension(tmp_path / name)["meta"] for name in ("one.vrm", "two.vrm"))
    assert (one["name"], one["version"], one["authors"]) == ("Ann", "7", ["Someone Else, CC0 1.0"])
    assert (two["name"], two["authors"], two["copyrightInformation"]) == ("two", ["Me", "You"], "Someone Else, CC0 1.0")


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
    ],
    ids=["mixamo", "mixamo namespace", "vroid", "unreal", "rigify"],
)
def test_joints_are_known_by_the_names_of_their_convention(names: str) -> None:
    expected = ["hips", "spine", "chest", "upperChest", "neck", "head"]
    parts = ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes", "Eye")
    joints = []
    for side in ("Left", "Right"):
        expected += [f"{side.lower()}{part}" for part in parts]
        joints += [word.format(side, L=side[0], l=side[0].lower()) for word in names.split()]
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


def test_no_emotion_opens_the_mouth_or_closes_the_eyes_twice() -> None:
    for emotion in EMOTIONS:
        for other in (*VOWELS, *BLINKS):
            for shape in ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight"):
                assert sum(table()["preset"][one].get(shape, 0.0) for one in (emotion, other)) <= 1
    assert all({*weights} <= ARKIT_SHAPES for weights in table()["preset"].values())


def test_a_face_with_shapes_of_its_own_for_presets_keeps_them(tmp_path: Path) -> None:
    parts = tiny_face()
    names = dict(zip(("jawOpen", "smile"), ("Fcl_ALL_Joy", "neutral"), strict=True))
    meshes = tuple(
        replace(mesh, blendshapes=tuple(replace(one, name=names.get(one.name, one.name)) for one in mesh.blendshapes))
        for mesh in parts.meshes
    )
    exported(replace(parts, meshes=meshes), tmp_path / "own.vrm")
    expressions = extension(tmp_path / "own.vrm")["expressions"]
    assert expressions["preset"]["happy"] == expressions["custom"]["Fcl_ALL_Joy"]
    assert expressions["preset"]["happy"]["morphTargetBinds"]


def test_import_reads_the_model_as_it_stands(tmp_path: Path) -> None:
    parts = head()
    exported(parts, tmp_path / "head.vrm")
    back = gltf.read(tmp_path / "head.vrm", gltf.Options()).parts
    for weights in ({}, {"jawOpen": 0.6, "mouthSmileLeft": 0.9}):
        expected = evaluated(parts, weights)
        found = evaluated(back, weights)
        apart = (found - expected).mean(axis=0)
        assert apart[1] > 1
        assert np.linalg.norm(found - expected - apart, axis=1).max() < TOLERANCE * head_height(parts)


DAMAGES: dict[str, Any] = {
    "VrmVersion": lambda one: one["extensions"]["VRMC_vrm"].update(specVersion="0.9"),
    "VrmMeta": lambda one: one["extensions"]["VRMC_vrm"]["meta"].pop("licenseUrl"),
    "VrmHumanBones": lambda one: one["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"].pop("leftFoot"),
    "VrmScales": lambda one: one["nodes"][-1].update(scale=[1, 1, -1]),
    "VrmPose": lambda one: swap(one, "leftUpperLeg", "rightUpperLeg"),
    "VrmExpressions": lambda one: one["extensions"]["VRMC_vrm"]["expressions"]["custom"]["jawOpen"]["morphTargetBinds"][
        0
    ].update(index=99),
    "VrmLookAt": lambda one: one["extensions"]["VRMC_vrm"]["lookAt"].update(type="bone"),
}


@pytest.mark.parametrize("check", DAMAGES)
def test_validate_finds(check: str, tmp_path: Path) -> None:
    parts = tiny_face()
    marks = {"multipie68": Landmarks(indices=np.arange(68) % len(parts.meshes[0].points))}
    exported(
        replace(parts, meshes=(replace(parts.meshes[0], landmarks=marks), *parts.meshes[1:])), tmp_path / "one.vrm"
    )
    findings = vrm.validate(tmp_path / "one.vrm", khronos=False)
    assert not [one for one in findings if one.severity == "error"]
    document = read_json(tmp_path / "one.vrm")
    DAMAGES[check](document)
    data = (tmp_path / "one.vrm").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    (tmp_path / "two.vrm").write_bytes(head + text + rest)
    found = {one.check for one in vrm.validate(tmp_path / "two.vrm", khronos=False)}
    assert f"facepipe:{check}" in found - {one.check for one in findings}


WEIRD = st.sampled_from([None, True, -1, 1.5, 1e999, "x", [], [None], {}, {"node": "x"}, {"": 0}, [[1]], 2**70])


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_hostile_files_are_judged_not_believed(data: st.DataObject, tmp_path: Path) -> None:
    """Whatever stands in the extension, the checks end, and say so where it is no VRM any more."""
    document = deepcopy(tiny_document())
    for _ in range(data.draw(st.integers(1, 4))):
        place: Any = document
        while isinstance(place, dict | list) and place:
            key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
            if not isinstance(place[key], dict | list) or not place[key] or data.draw(st.booleans()):
                place[key] = deepcopy(data.draw(WEIRD))
                break
            place = place[key]
    path = tmp_path / "hostile.vrm"
    text = json.dumps(document).encode()
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)
    assert all("\n" not in one.message for one in vrm.validate(path, khronos=False))


@cache
def tiny_document() -> Any:
    """The JSON of a small model, of what VRM's checks read."""
    with tempfile.TemporaryDirectory() as folder:
        exported(tiny_face(), Path(folder) / "one.vrm", shapes="jawOpen", morph_normals=False)
        document = read_json(Path(folder) / "one.vrm")
    return {key: document[key] for key in ("asset", "extensions", "extensionsUsed", "meshes", "nodes", "scenes")}


def swap(document: Any, one: str, other: str) -> None:
    """Exchange the places of two human bones' nodes."""
    bones = document["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
    a, b = (document["nodes"][bones[bone]["node"]] for bone in (one, other))
    a["translation"], b["translation"] = b["translation"], a["translation"]


def read_json(path: Path) -> Any:
    """The JSON of a GLB."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size])


def extension(path: Path) -> Any:
    """The VRM extension of a file."""
    return read_json(path)["extensions"]["VRMC_vrm"]


@pytest.mark.slow
def test_the_set_face_is_delivered(tmp_path: Path) -> None:
    """Sliders of the person are in the rest, and shapes play on top; the template comes by --pose rest."""
    values = {"noseWidth": 0.8, "jawWidth": -0.7}
    template = head()
    parts = replace(
        template, sliders=tuple(replace(one, value=values.get(one.name, one.value)) for one in template.sliders)
    )
    report = exported(parts, tmp_path / "set.vrm")
    exported(parts, tmp_path / "rest.vrm", pose="rest")
    assert report.pose != "rest"
    coefficients, _ = slide(parts.sliders, parts.skeleton.joints)
    person = build(four(parts)).evaluate({}, coefficients=coefficients) * parts.meters_per_unit
    for name, expected in (("set.vrm", person), ("rest.vrm", evaluated(parts, {}))):
        _, (found,) = seen(tmp_path / name, parts, [{}])
        used = np.isfinite(found).all(axis=1)
        apart = (found - expected)[used].mean(axis=0)
        assert off(found, expected + apart, parts) < TOLERANCE
    assert np.abs(person - evaluated(parts, {})).max() > 1e-3
    with pytest.raises(InputError, match="expected set or rest"):
        exported(parts, tmp_path / "no.vrm", pose="set-joints")


def test_sliders_called_as_arkit_shapes_become_expressions(tmp_path: Path) -> None:
    """At full value an expression is what the slider does, joints, shapes and all."""
    parts = tiny_face()
    shape = parts.meshes[0].blendshapes[1].name
    channels = (("root/jaw", "rx", 0.4), ("root/jaw", "sy", 0.2), ("root", "tz", 0.1))
    slider = Slider(name="MouthFunnel", maximum=2.0, channels=channels, shapes=((shape, 0.3),))
    parts = replace(parts, sliders=(slider, Slider(name="width", channels=channels)))
    report = exported(parts, tmp_path / "head.vrm")
    assert any("1 shape that sliders make (mouthFunnel)" in line for line in report.added)
    answer, (rest, found) = seen(tmp_path / "head.vrm", parts, [{}, {"expressions": {"mouthFunnel": 1.0}}])
    coefficients, weights = slide(parts.sliders, parts.skeleton.joints, {"MouthFunnel": 2.0})
    rig = build(parts)
    expected = rig.evaluate(weights, coefficients=coefficients) - rig.evaluate({})
    used = np.isfinite(rest).all(axis=1)
    assert np.abs(expected).max() > 0.1
    assert np.abs(found - rest - expected * parts.meters_per_unit)[used].max() < TOLERANCE * head_height(parts)
    assert "width" not in answer["expressions"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sample", "ict", "makehuman"])
def test_three_vrm_moves_whole_faces_as_their_rigs_do(kind: str, tmp_path: Path) -> None:
    parts, joint = face(kind)
    presets = PRESETS if kind != "makehuman" else ()
    own = [shape.name for shape in parts.meshes[0].blendshapes][:5]
    path = tmp_path / "head.vrm"
    check_motion(parts, path, presets, own, joint)
    check_sliders(parts, path)
    report = validate([path])[path]["issues"]
    assert report["numErrors"] == report["numWarnings"] == 0
    assert not [one for one in vrm.validate(path, khronos=False) if one.severity != "info"]


def check_sliders(parts: FaceParts, path: Path) -> None:
    """Every expression that a slider became is at full value what the slider does, and a face has each once."""
    wanted = [one.name for one in parts.sliders if one.name in ARKIT_SHAPES]
    own = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes}
    rig = build(parts)
    answer, found = seen(path, parts, [{}, *({"expressions": {name: 1.0}} for name in wanted if name not in own)])
    assert len(answer["expressions"]) == len({*answer["expressions"]})
    for name, points in zip((one for one in wanted if one not in own), found[1:], strict=True):
        coefficients, weights = slide(parts.sliders, parts.skeleton.joints, {name: 1.0})
        moved = (rig.evaluate(weights, coefficients=coefficients) - rig.evaluate({})) * parts.meters_per_unit
        assert off(points, found[0] + moved, parts) < TOLERANCE, name


def face(kind: str) -> tuple[FaceParts, str | None]:
    """A real face, and its head joint."""
    if kind == "sample":
        return head(), "root/neck/head"
    if kind == "ict":
        return load("ict", shared("ict_facekit/ict_facekit.npz")).parts, None
    from facepipe.importers.makehuman import Options

    options = Options(shapes="expression/caucasian/*", sliders="arkit")
    parts = load("makehuman", shared("makehuman/makehuman_head.npz"), options).parts
    return parts, next(joint for joint in parts.skeleton.joints if joint.endswith("/head"))
