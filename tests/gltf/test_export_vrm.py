"""VRM 1.0: what three-vrm makes of a file is what the face is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_gltf import read as gltf
from facepipe_gltf import vrm
from facepipe_gltf.vrm.bones import REQUIRED
from facepipe_gltf.vrm.expressions import table
from faces import tiny_face
from gltf_export import TOLERANCE, head_height
from import_data import shared
from node import validate
from vrm_export import (
    BLINKS,
    EMOTIONS,
    HEAD_TURN,
    LOOKS,
    VOWELS,
    evaluated,
    exported,
    extension,
    four,
    head,
    rotation,
    seen,
)

from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.parts import FaceParts, FloatArray, Slider
from facepipe.rig import build, slide
from facepipe.rig.conventions import ARKIT_SHAPES

PRESETS = (*EMOTIONS, *VOWELS, *BLINKS, *LOOKS)


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
    answer = check_motion(parts, tmp_path / "head.vrm", ["happy", "blink"], ["jawForward"], "root/neck/head")
    assert {*PRESETS, "neutral"} <= {*answer["expressions"]}
    assert {*ARKIT_SHAPES} & {shape.name for shape in parts.meshes[0].blendshapes} <= {*answer["expressions"]}
    assert {*REQUIRED, "neck", "jaw", "leftEye", "rightEye"} == {*answer["bones"]}
    assert answer["meta"]["authors"] == ["someone"]


@pytest.mark.parametrize("kind", ["sample", pytest.param("makehuman", marks=pytest.mark.slow)])
def test_eyes_look_at_what_is_within_their_reach(kind: str, tmp_path: Path) -> None:
    """Each eye turns by the angles at which the point between both sees the target, however its joint is turned."""
    parts, _ = face(kind)
    exported(parts, tmp_path / "head.vrm")
    answer, _ = seen(tmp_path / "head.vrm", parts, [{}])
    between = np.mean([answer["bones"][eye] for eye in ("leftEye", "rightEye")], axis=0)
    rest = {eye: rotation(turn) for eye, turn in answer["poses"][0]["eyes"].items()}
    targets = ([0.3, 0.2, 1.0], [-0.4, -0.3, 1.2], [0.0, 0.0, 2.0], [3.0, 0.0, 1.0], [0.0, 9.0, 9.0])
    answer, _ = seen(tmp_path / "head.vrm", parts, [{"lookAt": (between + target).tolist()} for target in targets])
    for (x, y, z), pose in zip(targets, answer["poses"], strict=True):
        for eye, turn in pose["eyes"].items():
            forward = rotation(turn) @ rest[eye].T @ [0.0, 0.0, 1.0]
            yaw, pitch = np.degrees(np.arctan2(forward[0], forward[2])), np.degrees(np.arcsin(forward[1]))
            assert yaw == pytest.approx(np.clip(np.degrees(np.arctan2(x, z)), -28, 28), abs=1e-3)
            wanted = np.degrees(np.arctan2(y, np.hypot(x, z)))
            assert pitch == pytest.approx(np.clip(wanted, -14, 14), abs=1e-3)


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
        replace(
            mesh,
            blendshapes=tuple(
                replace(blendshape, name=names.get(blendshape.name, blendshape.name)) for blendshape in mesh.blendshapes
            ),
        )
        for mesh in parts.meshes
    )
    report = exported(replace(parts, meshes=meshes), tmp_path / "own.vrm")
    smiles = [name for name, weights in table()["preset"].items() if "mouthSmileLeft" in weights]
    absent = [name for name in table()["preset"] if name not in ("neutral", *smiles)]
    assert f"the expressions {', '.join(absent)} (no shape of the face belongs to them)" in report.dropped
    expressions = extension(tmp_path / "own.vrm")["expressions"]
    assert expressions["preset"]["happy"] == expressions["custom"]["Fcl_ALL_Joy"]
    assert expressions["preset"]["happy"]["morphTargetBinds"]


def test_shapes_that_another_tool_named_make_presets_on_every_mesh(tmp_path: Path) -> None:
    parts = tiny_face()
    mesh, shape = parts.meshes[0], parts.meshes[0].blendshapes[0]
    made = [
        replace(mesh, name=name, blendshapes=tuple(replace(shape, name=f"{name}__facs_bs_{one}") for one in moved))
        for name, moved in {"Genesis9": ("EyeBlinkLeft", "EyeBlinkRight"), "Lashes": ("EyeBlinkRight",)}.items()
    ]
    exported(replace(parts, meshes=tuple(made)), tmp_path / "daz.vrm")
    preset = extension(tmp_path / "daz.vrm")["expressions"]["preset"]
    binds = {name: [(one["node"], one["index"]) for one in preset[name]["morphTargetBinds"]] for name in BLINKS}
    assert [len(binds[name]) for name in ("blinkLeft", "blinkRight", "blink")] == [1, 2, 3]
    assert {*binds["blink"]} == {*binds["blinkLeft"], *binds["blinkRight"]}


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


@pytest.mark.slow
def test_the_set_face_is_delivered(tmp_path: Path) -> None:
    """Sliders of the person are in the rest, and shapes play on top; the template comes by --pose rest."""
    values = {"noseWidth": 0.8, "jawWidth": -0.7}
    template = head()
    parts = replace(
        template,
        sliders=tuple(replace(slider, value=values.get(slider.name, slider.value)) for slider in template.sliders),
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
def test_shapes_look_where_a_face_has_no_eye_joints(tmp_path: Path) -> None:
    """As far as the angle is of the one where the shapes are fully on."""
    parts, _ = face("ict")
    exported(parts, tmp_path / "head.vrm", morph_normals=False)
    answer, _ = seen(tmp_path / "head.vrm", parts, [])
    assert answer["lookAt"]["type"] == "expression"
    eyes = np.add(answer["bones"]["head"], answer["lookAt"]["offset"])
    angle = np.radians(14)  # of 28
    left = np.add(eyes, [np.sin(angle), 0, np.cos(angle)])
    _, (rest, found) = seen(tmp_path / "head.vrm", parts, [{}, {"lookAt": left.tolist()}])
    moved = evaluated(parts, {"eyeLookOutLeft": 0.5, "eyeLookInRight": 0.5}) - evaluated(parts, {})
    assert off(found, rest + moved, parts) < TOLERANCE
    assert np.abs(moved).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("sample", marks=pytest.mark.gate), "ict", "makehuman"])
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
    wanted = [slider.name for slider in parts.sliders if slider.name in ARKIT_SHAPES]
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
