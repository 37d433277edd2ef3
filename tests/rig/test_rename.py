"""`--rename`: shapes and joints under other names, wherever a face and its files speak of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gltf_reader
import numpy as np
import pytest
from command_line import done, failed, run
from facepipe_onnx.runtime import Deformer
from faces import clipped_face, tiny_face
from gltf_builder import build, make_model
from places import SHARED

import facepipe
from facepipe.core.errors import InputError
from facepipe.importers import ict, load
from facepipe.importers.rename_table import rename_of
from facepipe.parts import Animation, FaceParts, Slider
from facepipe.rig.conventions import (
    ARKIT_SHAPES,
    CONVENTIONS,
    convention_names,
    convention_of,
    convention_text,
    meaning,
    renamed,
)
from facepipe.stage import Face, save_parts
from facepipe.verbs.animate import AnimateFace, Performance

ICT = SHARED / "ict_facekit" / "ict_facekit.npz"


@pytest.fixture
def face(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    save_parts(clipped_face(), tmp_path / "face.usda")
    return tmp_path / "face.usda"


TABLE = {"jawOpen": "Mund auf", "mouthSmileLeft": "笑う", "jaw": "mixamorig:Jaw", "root/jaw/lip": "DEF-lip.001"}


@pytest.mark.parametrize("kind", ["json", "csv"])
def test_a_table_renames_every_place_in_the_files(
    capsys: pytest.CaptureFixture[str], face: Path, tmp_path: Path, kind: str
) -> None:
    table = tmp_path / f"names.{kind}"
    rows = ["old,new", "", *(f'"{old}","{new}"' for old, new in TABLE.items())]
    table.write_text(json.dumps(TABLE) if kind == "json" else "\r\n".join(rows), encoding="utf-8")
    done(capsys, "export", face, "-o", "new.glb", "--animations", "--rename", table, quiet=False)
    written = gltf_reader.read(tmp_path / "new.glb")
    assert written.targets("Head") == ["Mund auf", "Mund auf_half", "笑う"]
    inbetweens = written.mesh("Head")["extras"]["facepipe"]["inbetweens"]
    assert inbetweens == {"Mund auf_half": {"shape": "Mund auf", "weight": 0.5}}
    assert written.joint_names() == ["root", "mixamorig:Jaw", "DEF-lip.001"]
    original = facepipe.open(face)
    for weight in (0.3, 1.0):
        points = written.evaluate({"Mund auf": weight})["Head"]
        expected = original.split(original.evaluate({"jawOpen": weight}))["Head"] * original.meters_per_unit
        np.testing.assert_allclose(points, expected, atol=1e-6)
    expected = original.split(original.evaluate({"jawOpen": 0.4}))["Head"] * original.meters_per_unit
    np.testing.assert_allclose(written.pose("talk", 0.5)["Head"], expected, atol=1e-6)


def test_graphs_take_the_new_names(capsys: pytest.CaptureFixture[str], face: Path, tmp_path: Path) -> None:
    Path("names.json").write_text(json.dumps(TABLE), encoding="utf-8")
    done(capsys, "export", face, "-o", "new.onnx", "--rename", "names.json", quiet=False)
    deformer = Deformer("new.onnx")
    assert deformer.shapes == ("Mund auf", "笑う")
    assert deformer.joint_names == ("root", "mixamorig:Jaw", "DEF-lip.001")
    found = deformer.evaluate({"Mund auf": 0.7})["points"]
    np.testing.assert_allclose(found, facepipe.open(face).evaluate({"jawOpen": 0.7}), atol=1e-5)
    done(capsys, "export", face, "--sliders", "-o", "sliders.onnx", "--rename", "names.json", quiet=False)
    record = json.loads(Path("sliders.onnx.json").read_text(encoding="utf-8"))
    assert "jawOpen" not in json.dumps(record)
    assert {row[0] for one in record["sliders"] for row in one["shapes"]} == {"Mund auf", "笑う"}


def test_names_of_a_face_follow_on_the_stage() -> None:
    before = Face.from_parts(clipped_face())
    after = Face.from_parts(renamed(clipped_face(), TABLE, "table"))
    assert after.shapes == ("Mund auf", "笑う")
    assert after.skeleton.joints == before.skeleton.joints
    assert after.skeleton.names == ("root", "mixamorig:Jaw", "DEF-lip.001")
    for value in (0.4, 1.0):
        moved, expected = after.evaluate(sliders={"open": value}), before.evaluate(sliders={"open": value})
        np.testing.assert_allclose(moved, expected, atol=1e-6)
    assert after.sample("talk", 1)[1] == {"Mund auf": pytest.approx(0.8)}


def test_import_gives_the_names_of_a_convention_and_says_so(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = build(make_model())
    builder.root["meshes"][0]["extras"]["targetNames"] = ["Fcl_MTH_A", "blendShape1.EyeBlink_L", "Key 1"]
    (tmp_path / "vroid.glb").write_bytes(builder.glb())
    code, _, err = run(capsys, "import", "gltf", "vroid.glb", "face.usda", "--rename", "ARKIT")
    assert code == 0
    assert "--rename ARKIT: 1 names changed, like 'blendShape1.EyeBlink_L' to 'eyeBlinkLeft'" in err
    made = facepipe.open("face.usda")
    assert made.shapes == ("Fcl_MTH_A", "eyeBlinkLeft", "Key 1")
    recipe = made.parts().recipe
    assert recipe is not None
    assert recipe.options["rename"] == {"blendShape1.EyeBlink_L": "eyeBlinkLeft"}
    code, _, err = run(capsys, "import", "gltf", "vroid.glb", "vrm.usda", "--rename", "vrm")
    assert (code, "VRM 1.0" in err) == (0, False)  # two names make no convention
    assert facepipe.open("vrm.usda").shapes == ("aa", "blinkLeft", "Key 1")


@pytest.mark.parametrize("rename", [(), ("--rename", "arkit")])
def test_a_file_of_another_tool_plays_a_clip_of_arkit_whether_renamed_or_not(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rename: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = build(make_model())
    names = ["A14_Eye_Blink_Left", "head_geo.A25_Jaw_Open", "A38_Mouth_Smile_Left_ncl1_1"]
    builder.root["meshes"][0]["extras"]["targetNames"] = names
    (tmp_path / "cc.glb").write_bytes(builder.glb())
    done(capsys, "import", "gltf", "cc.glb", "face.usda", *rename, quiet=False)
    shapes = ("eyeBlinkLeft", "jawOpen", "mouthSmileLeft")
    assert facepipe.open("face.usda").shapes == (shapes if rename else tuple(names))
    (tmp_path / "take.csv").write_text(
        "Frame,jawOpen,mouthSmileLeft,eyeBlinkLeft,tongueOut\n0,0,0,0,0\n1,1,0.5,0.25,1\n"
    )
    code, text, _ = run(capsys, "animate", "face.usda", "take.csv", "-o", "take.usda", "--json")
    assert (code, json.loads(text)["no_target"]) == (0, {"tongueOut": "no such shape"})
    moved = facepipe.open("take.usda").sample("take", 1)[1]
    assert [moved[shape] for shape in (shapes if rename else names)] == pytest.approx([0.25, 1.0, 0.5])


def test_a_convention_is_recognised_with_the_way_to_its_names(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    builder = build(make_model())
    builder.root["meshes"][0]["extras"]["targetNames"] = ["Eye_Blink_L", "Eye_Blink_R", "Jaw_Open"]
    (tmp_path / "cc.glb").write_bytes(builder.glb())
    hint = "ARKit, 3 of 52 in another spelling (--rename arkit gives its own)"
    assert hint in run(capsys, "import", "gltf", "cc.glb", "face.usda")[2]
    assert hint in run(capsys, "inspect", "face.usda")[1]
    assert hint not in run(capsys, "import", "gltf", "cc.glb", "own.usda", "--rename", "arkit")[2]
    assert json.loads(run(capsys, "inspect", "own.usda", "--json")[1])["shape_names"] == {
        "convention": "arkit",
        "title": "ARKit",
        "names": 3,
        "of": 52,
        "exact": True,
        "arkit": 0,
    }


def with_meshes(meshes: Sequence[Sequence[str]], clip: Sequence[Sequence[float]]) -> FaceParts:
    """A face of several meshes with shapes of these names, a clip that plays them all, a slider that opens the jaw."""
    parts = tiny_face()
    shape = parts.meshes[0].blendshapes[0]
    made = [
        replace(parts.meshes[0], name=f"mesh{i}", blendshapes=tuple(replace(shape, name=name) for name in names))
        for i, names in enumerate(meshes)
    ]
    shapes = tuple(name for names in meshes for name in names)
    talk = Animation(name="talk", times=np.arange(2.0), shapes=shapes, shape_weights=np.array(clip))
    slider = Slider(name="open", shapes=tuple((name, 0.5) for name in shapes if "Jaw" in name))
    return replace(parts, meshes=tuple(made), animations=(talk,), sliders=(slider,))


DAZ = [
    ["Genesis9__facs_bs_JawOpen", "Genesis9__facs_bs_EyeBlinkLeft"],
    ["G9Lashes__facs_bs_EyeBlinkLeft", "G9Lashes__facs_bs_JawOpen"],
]


def test_shapes_of_several_meshes_that_mean_the_same_are_one_control() -> None:
    parts = with_meshes(DAZ, [[0.0, 0.1, 0.1, 0.0], [0.8, 0.2, 0.2, 0.8]])
    after = rename_of("arkit")(parts)
    assert (after.warnings, after.parts.shapes) == ((), ("jawOpen", "eyeBlinkLeft"))
    assert after.names == dict(zip(parts.shapes, ("jawOpen", "eyeBlinkLeft", "eyeBlinkLeft", "jawOpen"), strict=True))
    clip = after.parts.animations[0]
    assert clip.shapes == ("jawOpen", "eyeBlinkLeft")
    assert clip.shape_weights is not None
    np.testing.assert_array_equal(clip.shape_weights, [[0.0, 0.1], [0.8, 0.2]])
    assert after.parts.sliders[0].shapes == (("jawOpen", 0.5),)


def test_shapes_that_a_clip_or_slider_moves_differently_are_no_one_control() -> None:
    parts = with_meshes(DAZ, [[0.0, 0.1, 0.1, 0.0], [0.8, 0.2, 0.2, 0.3]])
    with pytest.raises(InputError, match=r"'Genesis9__facs_bs_JawOpen' and 'G9Lashes__facs_bs_JawOpen' .* clip 'talk'"):
        rename_of("arkit")(parts)
    gains = replace(parts.sliders[0], shapes=((DAZ[0][0], 0.5), (DAZ[1][1], 0.25)))
    with pytest.raises(InputError, match="slider 'open' moves them differently"):
        rename_of("arkit")(replace(parts, animations=(), sliders=(gains,)))


def test_of_two_shapes_that_mean_the_same_the_closest_has_the_name_and_the_other_is_named() -> None:
    parts = with_meshes([["A25_Jaw_Open", "Jaw_Open", "A52_Tongue_Out"]], [[0.0, 0.1, 0.2], [0.5, 0.6, 0.7]])
    after = rename_of("arkit")(parts)
    assert after.parts.shapes == ("A25_Jaw_Open", "jawOpen", "tongueOut")
    assert after.warnings == ("--rename arkit: 1 shape keeps its name (A25_Jaw_Open): another means the same",)


@pytest.mark.parametrize("kind", ["cc3", "cc4", "daz", "daz9", "meta", "faceshift"])
def test_a_clip_of_arkit_plays_on_a_face_of_another_tool_as_on_the_same_with_arkits_names(kind: str) -> None:
    names = [name for meant, name in CONVENTIONS[kind].written.items() if meant in ARKIT_SHAPES]
    face = with_meshes([names], [[0.0] * len(names)] * 2)
    clip = Performance(where="t.csv", fps=30.0, names=(*sorted(ARKIT_SHAPES),), values=np.ones((2, 52)))
    played = [
        AnimateFace(performance=clip, name="take")(Face.from_parts(one))
        for one in (face, rename_of("arkit")(face).parts)
    ]
    assert len(played[0].shapes) == len(played[1].shapes) == len(names)
    assert [meaning(shape) for shape in played[0].shapes] == list(played[1].shapes)


def test_another_convention_is_recognised_with_what_arkit_has_of_it() -> None:
    shapes = ("blinkLeft", "blinkRight", "aa", "happy")
    assert convention_text(convention_of(shapes)) == "VRM 1.0, 4 of 18 (--rename arkit gives 2 of them ARKit's names)"
    assert convention_text(convention_of(("Key 1", "jawOpen"))) == "of no known convention"


@pytest.mark.skipif(not ICT.exists(), reason="ICT-FaceKit is not in ../shared/data")
def test_a_real_head_goes_to_another_convention_and_back() -> None:
    parts = load("ict", ICT, ict.Options()).parts
    there = renamed(parts, convention_names("metahuman", parts.shapes), "metahuman")
    curves = {*CONVENTIONS["metahuman"].written.values()}
    assert curves - {*there.shapes} == {"CTRL_expressions_tongueOut"}  # which ICT-FaceKit has not
    back = renamed(there, convention_names("arkit", there.shapes), "arkit")
    assert back.shapes == parts.shapes
    assert {*back.shapes} >= ARKIT_SHAPES - {"browInnerUp", "cheekPuff", "tongueOut"}  # two of them by sides


MISTAKES = {
    "two to one": ("n.json", '{"jawOpen": "mouthSmileLeft"}', "'jawOpen' and 'mouthSmileLeft' would both be called"),
    "two joints to one": ("n.json", '{"jaw": "root"}', "joints 'root' and 'jaw' would both be called 'root'"),
    "one name twice": ("n.json", '{"a": "x", "b": "x"}', "'x' is the new name of 'a' too"),
    "empty": ("n.json", '{"jawOpen": ""}', "no pair of names"),
    "no text": ("n.json", '{"jawOpen": 3}', "no pair of names"),
    "nothing": ("n.json", "{}", "no names"),
    "a list": ("n.json", "[1]", "n.json"),
    "a row once more": ("n.csv", "old,new\na,b\na,c", "row 3: 'a' once more"),
    "three columns": ("n.csv", "a,b,c", "3 columns, expected two"),
    "an open quote": ("n.csv", 'a,"b', "no CSV in UTF-8"),
    "another suffix": ("n.txt", "a,b", "expected .json or .csv"),
    "no file": ("lost.csv", None, "lost.csv"),
    "no convention": ("arkti", None, "no convention, did you mean 'arkit'?"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_tables_that_can_not_be_are_one_line(capsys: pytest.CaptureFixture[str], face: Path, case: str) -> None:
    name, text, message = MISTAKES[case]
    if text is not None:
        Path(name).write_text(text)
    assert message in failed(capsys, "export", face, "-o", "x.glb", "--rename", name, folder=face.parent)


def test_names_that_are_not_there_are_named_with_the_nearest(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    Path("names.json").write_text(json.dumps({"jawOpn": "a", "mouthSmileLeft": "b"}))
    code, _, err = run(capsys, "export", face, "-o", "x.glb", "--rename", "names.json")
    assert code == 0
    assert "1 of 2 names are not on the face, such as 'jawOpn', did you mean 'jawOpen'?" in err
