"""`facepipe fit-photo`: what it makes, what it keeps, and what it refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import photo_files
import pytest
from command_line import exit_code, failed, run
from faces import with_meshes
from feature_graphs import coarse_picture, save
from onnx import TensorProto, helper
from photographed_face import EXPRESSION, FAST, SIZE, SOON, contents, fit_json, fit_photo, write_photos
from PIL import Image
from small_head import make
from with_torch import torch
from without_torch import HINT, without_torch

import facepipe
from facepipe.core.atomic import replacing_folder
from facepipe.core.errors import InputError
from facepipe.performing import read_kept
from facepipe.photo.fit import FitPhoto, read_landmarks, read_photo
from facepipe.rig import set_face
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch

ONE = ("front.png", "head.usdc", "--landmarks", "front.json")
TWO = ("front.png", "--landmarks", "front.json", "side.png", "--landmarks", "side.json", "head.usdc")  # in turn


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """head.usdc, front.png, side.png and their landmarks."""
    folder = tmp_path_factory.mktemp("made")
    parts = make(0)
    save_parts(parts, folder / "head.usdc")
    write_photos(parts, folder)
    return folder


@pytest.fixture
def studio(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with those files."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def fitted(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with person.usda, the fit of the front photo, and its report; never changed."""
    folder = tmp_path_factory.mktemp("fitted")
    shutil.copytree(made, folder, dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert fit_photo(*ONE, "-o", "person.usda", "--report", "report", *FAST) == 0
    return folder


@pytest.fixture
def person(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of that as the working folder."""
    shutil.copytree(fitted, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# What it makes


def test_the_stage_holds_person_and_expression_apart(fitted: Path) -> None:
    face = facepipe.open(fitted / "person.usda")
    values = {slider.name: slider.value or 0.0 for slider in face.sliders}
    assert values["jawWidth"] < -0.25  # of -0.7
    assert values["mouthWidth"] > 0.1  # of 0.7
    assert values["eyeSpacing"] > 0.0  # of 0.6, which is 1.1 mm: how much of it is found depends on the libraries
    neutral, pose = (
        next(animation for animation in face.animations if animation.name == name) for name in ("sliders", "front")
    )
    weights = {} if neutral.shape_weights is None else dict(zip(neutral.shapes, neutral.shape_weights[0], strict=True))
    assert not {name for name, weight in weights.items() if weight and name in ARKIT_SHAPES}
    assert pose.shape_weights is not None
    assert dict(zip(pose.shapes, pose.shape_weights[0], strict=True))["jawOpen"] > EXPRESSION["jawOpen"] / 2
    (view,) = face.photos
    assert (view.image, view.width, view.height) == ("front.png", SIZE, SIZE)


def test_a_person_is_a_payload_without_a_face_or_a_result(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Onto the head in the box, which the line does not name; with a result the same bytes."""
    before = contents(studio)
    words = ("front.png", "--landmarks", "front.json", *SOON, "--person", "me.fpb")
    run(capsys, "fit-photo", *words, "--json")
    assert contents(studio).keys() - before.keys() == {"me.fpb"}
    data = Path("me.fpb").read_bytes()
    assert len(data) < 400
    _, out, _ = run(capsys, "fit-photo", *words, "-o", "me.usdc", "--json", "--force")
    told = json.loads(out)["person"]
    assert (Path("me.fpb").read_bytes(), told["bytes"]) == (data, len(data))
    assert told["max_mm"] <= 1.0
    assert exit_code("sample", "standard.usdc") == 0
    assert exit_code("apply-bones", "standard.usdc", "me.fpb", "-o", "again.usdc") == 0
    one, other = (set_face(facepipe.open(name).parts()).parts for name in ("me.usdc", "again.usdc"))
    points = [np.concatenate([mesh.points for mesh in parts.meshes[:5]]) for parts in (one, other)]
    assert 10 * np.linalg.norm(points[0] - points[1], axis=1).mean() < 0.05


def test_a_cook_fits_again_where_landmarks_were_mended(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To the bytes of the command, and the exit code of a threshold that is missed."""
    words = (*ONE, "-o", "person.usda", *SOON, "--expression", "jawOpen")
    assert fit_photo(*words) == 0
    before = contents(studio)
    mended = json.loads(Path("front.json").read_text())
    mended["multipie68"] = (np.array(mended["multipie68"]) + np.eye(68, 2) * 40).tolist()
    Path("front.json").write_text(json.dumps(mended))
    assert exit_code("cook", "person.usda", "--dry-run") == 1
    code = exit_code("cook", "person.usda")
    assert "person.usda: fit-photo: cooked" in capsys.readouterr().out
    cooked = contents(studio)
    assert cooked != before
    assert fit_photo(*words, "--force") == code
    assert contents(studio) == cooked


def test_the_report_is_a_folder_of_what_was_found(fitted: Path) -> None:
    folder = fitted / "report"
    expected = {"report.json", "report.html", "front.landmarks.json", "front.render.png", "front.overlay.png"}
    assert {one.name for one in folder.iterdir()} == expected
    report = json.loads((folder / "report.json").read_text())
    assert report["photos"]["front.png"]["landmark_error_px"] < 1.5
    assert not {"seconds", "fitted"} & report.keys()  # no times, no arrays
    photo = read_photo(fitted / "front.png")
    given, kept = (
        read_landmarks(path, photo).points for path in (fitted / "front.json", folder / "front.landmarks.json")
    )
    np.testing.assert_allclose(kept, given, atol=0.001)
    with Image.open(folder / "front.render.png") as image:
        assert (image.mode, image.size) == ("RGBA", (SIZE, SIZE))
        alpha = np.asarray(image)[..., 3]
    x, y = given[27:].astype(int).T  # all within the face
    assert alpha[y, x].min() == 255
    assert alpha[:3].max() == 0  # above the head
    with Image.open(folder / "front.overlay.png") as image:
        assert max(image.size) == 1024


def test_render_shows_what_the_photo_shows(fitted: Path) -> None:
    """In the middle of the face the render has the photo's colours; a face at its defaults in grey light has not."""
    photo = read_photo(fitted / "front.png")
    marks = read_landmarks(fitted / "front.json", photo).points
    (left, top), (right, bottom) = marks[17:].min(axis=0).astype(int), marks[17:].max(axis=0).astype(int)
    with Image.open(fitted / "report" / "front.render.png") as image:
        render = np.asarray(image)[top:bottom, left:right, :3] / 255
    assert np.abs(render - photo.pixels[top:bottom, left:right]).mean() < 0.08


def test_engine_files_of_the_result_are_clean(person: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (
        "validate person.usda",
        "export person.usda -o person.glb",
        "validate person.glb",
        "export person.usda --sliders -o sliders.onnx",
        "validate sliders.onnx",
        "eval sliders.onnx -o matrices.npz",
    )
    for line in lines:
        assert exit_code(*line.split()) == 0, f"{line}: {capsys.readouterr()}"
    metadata = {prop.key: prop.value for prop in onnx.load(person / "sliders.onnx").metadata_props}
    values = {slider.name: slider.value for slider in facepipe.open("person.usda").sliders}
    text = "".join(metadata.values())
    assert f"{values['mouthWidth']:.4f}"[:5] in text  # the graph starts from the fitted person


def test_the_person_can_be_edited(person: Path) -> None:
    assert exit_code("sliders", "person.usda", "--set", "mouthWidth=0.1", "-o", "edited.usda") == 0
    before, after = (facepipe.open(name) for name in ("person.usda", "edited.usda"))
    assert {slider.name: slider.value for slider in after.sliders}["mouthWidth"] == pytest.approx(0.1)
    assert [photo.name for photo in after.photos] == [photo.name for photo in before.photos]


def test_photos_of_a_person_share_sliders(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = fit_json(capsys, *TWO, "-o", "person.usdc", "--flatten", *SOON)
    assert list(found["photos"]) == ["front.png", "side.png"]
    assert all(one["landmark_error_px"] < 1.5 for one in found["photos"].values())
    assert found["path"] == "person.usdc"
    assert found["seconds"] > 0
    (studio / "head.usdc").unlink()
    face = facepipe.open("person.usdc")  # flattened: on its own
    assert [photo.image for photo in face.photos] == ["front.png", "side.png"]
    yaw = [float(np.arctan2(photo.transform[0, 2], photo.transform[2, 2])) for photo in face.photos]
    assert yaw == pytest.approx([0.0, 0.25], abs=0.06)
    kept = read_kept("person.usdc", FitPhoto, ["face"]).values
    assert [one.name for one in kept["photos"]] == ["front.png", "side.png"]
    assert [one.name for one in kept["landmarks"]] == ["front.json", "side.json"]


def test_a_photo_on_its_side_gives_the_same_person(studio: Path) -> None:
    """Sliders, neutral and expression; its camera sees the face on its side."""
    with Image.open("front.png") as image:
        image.transpose(Image.Transpose.ROTATE_90).save("lying.png")
    x, y = np.array(json.loads(Path("front.json").read_text())["multipie68"]).T
    Path("lying.json").write_text(json.dumps({"multipie68": np.stack([y, SIZE - x], axis=1).tolist()}))
    faces = []
    for name in ("front", "lying"):
        assert fit_photo(f"{name}.png", "head.usdc", "--landmarks", f"{name}.json", "-o", f"{name}.usdc", *SOON) == 0
        faces.append(facepipe.open(f"{name}.usdc"))
    upright, lying = faces
    np.testing.assert_allclose(lying.evaluate(), upright.evaluate(), atol=1e-4)
    (one,), (other,) = upright.photos, lying.photos
    assert other.landmark_error == pytest.approx(one.landmark_error, abs=1e-3)
    np.testing.assert_allclose(other.transform[:3, 0], -one.transform[:3, 1], atol=1e-4)
    np.testing.assert_allclose(other.transform[:3, 3], one.transform[:3, 3], atol=1e-3)


def test_existing_files_need_force_and_the_same_input_gives_the_same_bytes(person: Path) -> None:
    before = contents(person)
    assert fit_photo(*ONE, "-o", "person.usda", *SOON) == 2
    assert fit_photo(*ONE, "-o", "other.usda", "--report", "report", *SOON) == 2
    assert contents(person) == before
    (person / "person.usda").write_text("old")
    (person / "report" / "report.html").write_text("old")
    assert fit_photo(*ONE, "-o", "person.usda", "--report", "report", "--force", *FAST) == 0
    assert contents(person) == before


def test_edit_fits_again_from_the_recipe(person: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With what the line changes: the same as a fit from anew; `report` is not part of it. Both say by the exit code
    that landmarks are off, and keep what they found."""
    words = ("--size", "64", "--sparsity", "0.4", "--iterations", "1", "--landmark-threshold", "0.1")
    missed = "of the distance of the outer eye corners, expected at most 0.1 %"
    assert fit_photo("--edit", "person.usda", *words) == 2  # would overwrite it
    capsys.readouterr()
    anew = (*ONE, "-o", "anew.usda", *FAST, *words)
    for line in (anew, ("--edit", "person.usda", *words, "--force")):
        assert fit_photo(*line) == 1
        _, err = capsys.readouterr()
        assert err.count("\n") == 1
        assert missed in err
    assert facepipe.open("anew.usda").photos
    assert (person / "person.usda").read_bytes() == (person / "anew.usda").read_bytes()


@pytest.mark.slow
def test_likeness_is_judged_by_a_network_of_the_caller(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(coarse_picture(32), studio / "net.onnx")
    words = (*ONE, *SOON, "--identity-model", "net.onnx", "--force")
    found = fit_json(capsys, *words, "-o", "person.usda", "--report", "report")
    alike = found["photos"]["front.png"]["similarity"]
    assert 0.5 < alike < 0.99999
    assert not found["similarity_fitted"], "the network was no term of the fit"
    assert f"similarity {alike:.3f}" in Path("report/report.html").read_text(encoding="utf-8")
    assert fit_photo(*words, "-o", "again.usda", "--similarity-threshold", str(alike - 1e-4)) == 0
    assert fit_photo(*words, "-o", "again.usda", "--similarity-threshold", str(alike + 1e-4)) == 1
    out, err = capsys.readouterr()
    assert f"front.png: similarity of {alike:.3f}, expected at least" in err
    assert f"  {alike:.3f}  " in out
    drawn = fit_json(capsys, *words, "-o", "again.usda", "--identity", "0.1", "--iterations", "1")
    assert drawn["similarity_fitted"]


def test_the_function_gives_the_bytes_of_the_command(studio: Path) -> None:
    assert fit_photo(*ONE, "-o", "person.usda", *FAST) == 0
    weights = {"content": 0.0, "identity": 0.0, "attributes": 0.0}
    sources = {"photos": [Path("front.png")], "landmarks": [Path("front.json")]}
    facepipe.fit_photo("head.usdc", **sources, out="again.usda", iterations=8, size=96, landmark_sigma=0.005, **weights)
    assert Path("again.usda").read_bytes() == Path("person.usda").read_bytes()


def test_what_no_photo_shows_is_reported(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the frontal photo the nose is seen, and a part of the ears is not; a photo from the side shows more."""
    front, both = (fit_json(capsys, *words, "-o", "person.usda", "--force", *SOON)["unseen"] for words in (ONE, TWO))
    assert front["nose"] < 0.2 < front["ears"]
    assert both["ears"] < front["ears"]
    assert all(both[name] <= share for name, share in front.items())


def test_a_loss_that_is_not_finite_keeps_the_best(person: Path, capsys: pytest.CaptureFixture[str]) -> None:
    brightness_network(person / "bright.onnx")
    words = ("--identity-model", "bright.onnx", "--identity", "1", "--iterations", "3")
    code = fit_photo("--edit", "person.usda", "-o", "kept.usda", *words, "--json")
    out, err = capsys.readouterr()
    assert code == 1, err
    assert json.loads(out)["stopped"] == "not-finite"
    assert "not finite" in err
    assert json.loads(out)["photos"]["front.png"]["landmark_error_px"] < 1.5
    assert read_kept("kept.usda", FitPhoto).values["identity_model"] == person / "bright.onnx"


def brightness_network(path: Path) -> None:
    """An identity of a picture that has values for grey, and NaN for anything brighter."""
    nodes = [
        helper.make_node("GlobalAveragePool", ["image"], ["mean"]),
        helper.make_node("Flatten", ["mean"], ["flat"]),
        helper.make_node("Sub", ["little", "flat"], ["less"]),
        helper.make_node("Sqrt", ["less"], ["features"]),
    ]
    little = helper.make_tensor("little", TensorProto.FLOAT, [3], [1e-3] * 3)
    graph = helper.make_graph(
        nodes,
        "bright",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 64, 64])],
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, 3])],
        [little],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8), path)
    path.with_name(f"{path.name}.json").write_text(
        json.dumps({"kind": "identity", "size": 64, "mean": [0.5] * 3, "std": [0.5] * 3, "crop": "face"})
    )


# Photos of every kind


def test_photos_turned_by_exif_are_seen_upright(person: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a fit of the same photo upright found."""
    upright = np.asarray(Image.open("front.png").convert("RGB"))
    (person / "turned.png").write_bytes(photo_files.oriented(upright, 6, "PNG"))
    turned = fit_json(capsys, "turned.png", *ONE[1:], "-o", "turned.usda", *FAST)
    plain = json.loads((person / "report" / "report.json").read_text())
    assert turned["sliders"] == plain["sliders"]
    assert turned["losses"] == plain["losses"]


@pytest.mark.usefixtures("studio")
def test_photos_of_other_kinds_are_fitted_and_reported(capsys: pytest.CaptureFixture[str]) -> None:
    image = Image.open("front.png").convert("RGB")
    grey = image.convert("LA")
    grey.putalpha(Image.new("L", image.size, 128))
    grey.save("grey.png")
    image.convert("CMYK").save("print.tif")
    marks = ("--landmarks", "front.json")
    found = fit_json(capsys, "grey.png", *marks, "print.tif", *marks, "head.usdc", "-o", "a.usda", *SOON)
    for name, words in (("grey.png", "has no colour"), ("grey.png", "transparent"), ("print.tif", "CMYK without")):
        assert any(name in line and words in line for line in found["warnings"]), words


# What it refuses


def _save(name: str, data: bytes) -> Callable[[], int]:
    return lambda: Path(name).write_bytes(data)


def _landmarks(change: Callable[[Any], Any]) -> Callable[[], None]:
    def write() -> None:
        points = json.loads(Path("front.json").read_text())["multipie68"]
        Path("bad.json").write_text(json.dumps({"multipie68": change(points)}))

    return write


def _cut_short() -> None:
    Image.open("front.png").convert("RGB").save("bad.jpg")
    data = Path("bad.jpg").read_bytes()
    Path("bad.jpg").write_bytes(data[: len(data) // 2])


def _plain() -> None:
    Image.new("RGB", (160, 128), (90, 120, 150)).save("bad.png")


def _small() -> None:
    Image.new("RGB", (40, 40)).save("bad.png")


def _face(change: str) -> Callable[[], None]:
    def write() -> None:
        from dataclasses import replace

        parts = make(0)
        parts = replace(parts, sliders=()) if change == "sliders" else with_meshes(parts, landmarks={})
        save_parts(parts, Path("bare.usdc"))

    return write


def _wrong_signature() -> None:
    brightness_network(Path("bad.onnx"))
    Path("bad.onnx.json").write_text(json.dumps({"kind": "content", "size": 64}))


def _report_of_other_files() -> None:
    Path("notes").mkdir()
    Path("notes/diary.txt").write_text("mine")


BAD = "bad.json"
BAD_INPUTS: dict[str, tuple[Callable[[], Any] | None, tuple[str, ...], str]] = {
    "nothing": (None, (), "PHOTO: none given, expected photos of one person, before the face (or --edit RESULT)"),
    "no photo": (None, ("head.usdc",), "PHOTO: none given, expected photos of one person"),
    "no such photo": (None, ("lost.png", *ONE[1:]), "lost.png"),
    "no such face": (None, ("front.png", "lost.usda", *ONE[2:]), "lost.usda"),
    "swapped": (None, ("head.usdc", "front.png", *ONE[2:]), "front.png"),
    "twice": (None, ("front.png", *ONE, "--landmarks", "front.json"), "front.png given twice"),
    "no picture": (_save("bad.jpg", b"no picture"), ("bad.jpg", *ONE[1:]), "is not a picture that can be read"),
    "truncated": (_cut_short, ("bad.jpg", *ONE[1:]), "bad.jpg: is damaged or cut short"),
    "small": (_small, ("bad.png", *ONE[1:]), "bad.png: is 40 x 40 pixels, expected at least 64"),
    "huge": (
        _save("bad.png", photo_files.png(12_000, 12_000, 8, 2, b"")), ("bad.png", *ONE[1:]),
        "bad.png: 12000 x 12000 pixels in ",
    ),
    "no face": (_plain, ("bad.png", "head.usdc"), "bad.png: no face found"),
    "several faces": (
        _landmarks(lambda points: [points, points]), ("front.png", "head.usdc", "--landmarks", BAD),
        "2 faces found, expected one, or an index from 0 to 1",
    ),
    "no such face in it": (None, (*ONE, "--face", "3"), "face 3 of 1"),
    "no number of a face": (None, (*ONE, "--face", "first"), "--face first: expected whole numbers from 0"),
    "seven digits of a face": (None, (*ONE, "--face", "1000000"), "--face 1000000: expected whole numbers from 0"),
    "outside": (
        _landmarks(lambda points: [[x + 90, y] for x, y in points]), ("front.png", "head.usdc", "--landmarks", BAD),
        "landmarks outside front.png",
    ),
    "too few": (_landmarks(lambda points: points[:60]), ("front.png", "head.usdc", "--landmarks", BAD), "60 points"),
    "NaN": (
        _landmarks(lambda points: [*points[:67], [float("nan"), 1]]), ("front.png", "head.usdc", "--landmarks", BAD),
        BAD,
    ),
    "landmarks of one": (None, ("side.png", *ONE), "--landmarks: 1 given, expected 2: one for each photo"),
    "both": (None, (*ONE, "--landmarker", "x.task"), "--landmarks: given with --landmarker"),
    "no bundle": (
        _save("bad.task", b"no bundle"), ("front.png", "head.usdc", "--landmarker", "bad.task"),
        "bad.task: is no MediaPipe task bundle",
    ),
    "faces of others": (None, (*ONE, "--face", "0", "--face", "0"), "--face: 2 given, expected one, or 1"),
    "no sliders": (_face("sliders"), ("front.png", "bare.usdc", *ONE[2:]), "bare.usdc -> Face -> sliders: none"),
    "no landmarks": (_face("landmarks"), ("front.png", "bare.usdc", *ONE[2:]), "bare.usdc -> Face"),
    "no such shape": (None, (*ONE, "--expression", "grin"), "head.usdc -> Face -> expression grin: no such shape"),
    "signature": (_wrong_signature, (*ONE, "--identity-model", "bad.onnx"), "bad.onnx"),
    "no model": (_save("bad.onnx", b"no model"), (*ONE, "--content-model", "bad.onnx"), "bad.onnx"),
    "iterations": (None, (*ONE, "--iterations", "-1"), "iterations: is -1, expected a number from 0"),
    "threshold": (None, (*ONE, "--landmark-threshold", "nan"), "landmark_threshold: is nan, expected a number"),
    "no judge": (
        None, (*ONE, "--similarity-threshold", "0.5"), "--similarity-threshold: given without --identity-model",
    ),
    "suffix": (None, (*ONE, "-o", "out.obj"), "out.obj"),
    "input as output": (None, (*ONE, "-o", "head.usdc", "--force"), "head.usdc: is an input"),
    "report in use": (None, (*ONE, "--report", "."), "holds head.usdc, which is read or written too"),
    "report of others": (
        _report_of_other_files, (*ONE, "--report", "notes", "--force"),
        "notes: holds diary.txt, expected an empty folder",
    ),
    "report that exists": (_report_of_other_files, (*ONE, "--report", "notes"), "notes: exists, expected a new folder"),
    "not fitted": (None, ("--edit", "head.usdc", "--force"), "head.usdc: has a recipe of 'sample'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_is_one_line_and_leaves_nothing(studio: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    prepare, words, expected = BAD_INPUTS[case]
    if prepare is not None:
        prepare()
    output = () if "-o" in words or "--edit" in words else ("-o", "out.usda")
    report = () if "--report" in words else ("--report", "report")
    weights = () if "--iterations" in words else SOON
    assert expected in failed(capsys, "fit-photo", *words, *output, *report, *weights)


def test_without_torch_the_hint_is_one_line(studio: Path) -> None:
    assert without_torch("fit-photo", *ONE, "-o", "out.usda") == (2, HINT)
    assert not (studio / "out.usda").exists()


def test_help_loads_no_torch() -> None:
    code = (
        "import sys; from facepipe.cli import main\n"
        "try: main(['fit-photo', '--help'])\n"
        "finally: assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "facepipe fit-photo portrait.jpg head.usdc" in done.stdout


# Folders that appear whole or not at all


def _broken(target: Path) -> None:
    with replacing_folder(target) as folder:
        (folder / "half").write_text("half")
        raise ZeroDivisionError


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "report"
    with pytest.raises(ZeroDivisionError):
        _broken(target)
    assert list(tmp_path.iterdir()) == []
    for text in ("first", "second"):
        with replacing_folder(target) as folder:
            (folder / text).write_text(text)
    assert contents(tmp_path) == {"report/second": b"second"}
    with pytest.raises(ZeroDivisionError):
        _broken(target)
    assert contents(tmp_path) == {"report/second": b"second"}
    with pytest.raises(InputError, match="is a file, expected a folder"):
        _broken(target / "second")
    with pytest.raises(InputError, match="the folder around it does not exist"):
        _broken(tmp_path / "a" / "b")


assert torch is not None  # `learned` skips this file where it is not installed
