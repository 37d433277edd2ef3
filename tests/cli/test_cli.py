"""The command line: exit codes, one-line errors, JSON, and nothing overwritten."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, failed, run
from faces import tiny_face
from full_faces import full_photo

import facepipe
from facepipe.cli import commands_of
from facepipe.stage import save_parts


@pytest.fixture
def face(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.usda"
    save_parts(tiny_face(), path)
    return path


@pytest.mark.parametrize("command", commands_of())
def test_every_command_has_help_with_an_example(capsys: pytest.CaptureFixture[str], command: str) -> None:
    out = done(capsys, command, "--help")
    assert f"facepipe {command}" in out.partition("example")[2]


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    out = done(
        capsys,
    )
    assert all(command in out for command in commands_of())
    assert facepipe.__version__ in run(capsys, "--version")[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nope"], "'nope' is no command"),
        (["inspect"], "FACE: none given"),
        (["inspect", "gone.usda"], "gone.usda: no such file"),
        (["export", "gone.usda", "-o", "x.fbx"], "suffix '.fbx', expected one of .glb .gltf .onnx"),
        (["sample", "x.obj"], "suffix '.obj', expected .usd .usda .usdc .usdz"),
        (["sample", "no/such/x.usda"], "the folder does not exist"),
        (["sample"], "no output file"),
        (["import", "max", "a", "b.usda"], "invalid choice"),
        (["import", "obj", "gone", "b.usda"], "gone"),
        (["transfer", "gone.glb", "-o", "x.usda", "--replace"], "gone.glb: "),
        (["render", "gone.usda", "-o", "x.jpg"], "expected .png"),
        (["landmarks", "gone.usda", "--from", "gone.json", "-o", "x.usda"], "gone.usda: no such file"),
        (["sample", "x.usda", "--seed", "-1"], "expected a number from 0 to 1e+09"),
        (["eval", "tiny.usda", "-o", "x.npz"], "suffix '.usda', expected .onnx"),
        (["eval", "tiny.glb", "-o", "x.npz"], "suffix '.glb', expected .onnx"),
        (["inspect", "a" * 300 + ".usda"], "aaa...: file name too long"),
        (["render", "tiny.usda", "-o", "x.png", "--bone", "nose:rx=1"], "no joint 'nose', expected one of root"),
        (["render", "tiny.usda", "-o", "x.png", "--bone", "jaw:qq=1"], "channel 'qq'"),
        (["landmarks", "tiny.usda", "--from", "/dev/zero", "-o", "x.usda"], "not a regular file"),
        (["import", "ict", "/dev/zero", "x.usda"], "not a regular file"),
    ],
)
def test_bad_usage_is_one_line_and_exit_2(
    capsys: pytest.CaptureFixture[str], face: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(face.parent)
    assert message in failed(capsys, *words)


def test_nothing_is_overwritten_without_force(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    before = face.read_bytes()
    points = face.with_name("points.json")
    points.write_text("[1, 2]")
    code, _, err = run(capsys, "landmarks", face, "--from", points, "-o", face, "--force")
    assert (code, "is an input" in err) == (2, True)
    out = face.with_name("out.usda")
    out.write_text("precious")
    code, _, err = run(capsys, "landmarks", face, "--from", points, "-o", out)
    assert (code, "--force" in err) == (2, True)
    assert out.read_text() == "precious"
    done(capsys, "landmarks", face, "--from", points, "-o", out, "--force")
    assert facepipe.open(out).landmarks("multipie68")[1].indices.tolist() == [1, 2]
    assert face.read_bytes() == before


def test_inspect_counts(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    code, out, _ = run(capsys, "inspect", face, "--json")
    summary = json.loads(out)
    assert code == 0
    assert [mesh["points"] for mesh in summary["meshes"]] == [36, 9]
    assert summary["shapes"] == ["jawOpen", "mouthSmileLeft"]
    assert summary["head_height_mm"] == pytest.approx(50)
    assert "root/jaw" in summary["joints"]
    code, out, _ = run(capsys, "inspect", face)
    assert "2: jawOpen, mouthSmileLeft" in out
    assert "photos" not in out
    photos = [replace(full_photo(), name=name, animation=None, tint={}) for name in ("side", "front")]
    assert re.search(r"^attach joint +none$", out, re.MULTILINE)
    parts = replace(facepipe.open(face).parts(), photos=tuple(photos), attach_joint="root/jaw")
    save_parts(parts, face.with_name("seen.usda"))
    out = done(capsys, "inspect", face.with_name("seen.usda"))
    assert [line.split(maxsplit=1)[1] for line in out.splitlines() if line.startswith("photos")] == ["2: side, front"]
    assert re.search(r"^attach joint +root/jaw$", out, re.MULTILINE)


def test_landmarks_of_every_form(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    source, out = face.with_name("points.json"), face.with_name("out.usda")
    source.write_text(json.dumps({"scheme": "brows", "indices": [3, 1], "names": ["l", "r"]}))
    code, text, _ = run(capsys, "landmarks", face, "--from", source, "-o", out, "--mesh", "Teeth", "--json")
    assert (code, json.loads(text)["schemes"]) == (0, {"brows": 2})
    mesh, landmarks = facepipe.open(out).landmarks("brows")
    assert (mesh.name, landmarks.indices.tolist(), landmarks.names) == ("Teeth", [3, 1], ("l", "r"))
    source.write_text(json.dumps({"left": 4, "right": 5}))
    done(capsys, "landmarks", face, "--from", source, "-o", out, "--force", "--scheme", "eyes", "--flatten")
    assert facepipe.open(out).landmarks("eyes")[1].names == ("left", "right")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 99]", "point 99, expected a whole number from 0 to 35"),
        ("[]", "expected a list of points"),
        ("[1.5]", "expected a whole number"),
        ("[true]", "expected a whole number"),
        ('{"a": "b"}', "point b, expected a whole number"),
        ('{"indices": [1, 2], "names": ["a", "a"]}', "as many different names as indices"),
        ('{"indices": [1], "scheme": "a b"}', "expected a scheme name"),
        ("not json", "is not JSON"),
        ("[" * 100000, "is not JSON"),
    ],
)
def test_bad_landmarks(capsys: pytest.CaptureFixture[str], face: Path, content: str, message: str) -> None:
    source, out = face.with_name("points.json"), face.with_name("out.usda")
    source.write_text(content)
    assert message in failed(capsys, "landmarks", face, "--from", source, "-o", out, folder=face.parent)


def test_export_and_eval_agree_with_the_stage(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    model, points = face.with_name("tiny.onnx"), face.with_name("points.npz")
    out = done(capsys, "export", face, "-o", model, "--json")
    assert json.loads(out)["bytes"] == model.stat().st_size
    words = ["--set", "jawOpen=0.7", "--bone", "jaw:rx=0.25", "--bone", "root/jaw/lip:sy=1.5"]
    done(capsys, "eval", model, *words, "-o", points)
    coefficients = np.zeros((3, 9))
    coefficients[:, 6:] = 1
    coefficients[1, 3], coefficients[2, 7] = 0.25, 1.5
    expected = facepipe.open(face).evaluate({"jawOpen": 0.7}, coefficients=coefficients)
    np.testing.assert_allclose(np.load(points)["points"].reshape(-1, 3), expected, atol=1e-5)
    for bad in (["--set", "jawOpen"], ["--set", "nope=1"], ["--bone", "nose:rx=1"], ["--bone", "jaw:qq=1"]):
        failed(capsys, "eval", model, *bad, "-o", points, "--force", folder=face.parent)


def test_export_refuses_unknown_options_of_the_other_format(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    code, _, err = run(capsys, "export", face, "-o", face.with_suffix(".onnx"), "--mode", "skin")
    assert (code, "unrecognized arguments" in err) == (2, True)


def test_render_poses_and_heatmaps(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    from PIL import Image

    def drawn(*words: str) -> np.ndarray:
        out = face.with_name("out.png")
        done(capsys, "render", face, "-o", out, "--size", "64", "--force", *words)
        return np.asarray(Image.open(out).convert("RGB"), dtype=int)

    neutral = drawn()
    assert np.abs(drawn("--set", "mouthSmileLeft=1") - neutral).max() > 20
    assert np.abs(drawn("--view", "side") - neutral).max() > 20
    assert np.abs(drawn("--bone", "jaw:ry=1") - neutral).max() > 20
    assert drawn("--heatmap", "facepipe:region:mouth").std(axis=2).max() > 20
    code, _, err = run(capsys, "render", face, "-o", face.with_name("x.png"), "--heatmap", "nope")
    assert (code, "no primvar 'nope'" in err) == (2, True)


def test_validate_exit_codes(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    done(capsys, "validate", face)
    text = face.read_text()
    face.write_text(text.replace("facepipe:anchor = 2", "facepipe:anchor = 200"))
    code, out, _ = run(capsys, "validate", face, "--json")
    assert code == 1
    assert json.loads(out)["errors"] == 1


def test_schema_path_holds_the_plugin(capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, "schema-path")
    assert (Path(out.strip()) / "plugInfo.json").is_file()


def test_what_a_stage_needs_is_not_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from full_faces import full_face

    head, layer, points = tmp_path / "head.usda", tmp_path / "layer.usda", tmp_path / "points.json"
    save_parts(full_face(), head)
    points.write_text("[1, 2]")
    done(capsys, "landmarks", head, "--from", points, "-o", layer)
    before = {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()}
    attempts = [
        ("landmarks", layer, "--from", points, "-o", head, "--force"),
        ("import", "usd", layer, head, "--force"),
        ("render", layer, "-o", tmp_path / "head_textures" / "skin.png", "--force"),
    ]
    for words in attempts:
        code, _, err = run(capsys, *words)
        assert (code, "is needed by" in err) == (2, True), err
    assert {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()} == before


def test_the_sidecar_is_not_overwritten_without_force(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    sidecar = face.with_name("k.onnx.json")
    sidecar.write_text("precious")
    code, _, err = run(capsys, "export", face, "-o", face.with_name("k.onnx"))
    assert (code, sidecar.read_text()) == (2, "precious")
    assert "k.onnx.json" in err


def test_new_landmarks_leave_no_names_of_earlier_ones(capsys: pytest.CaptureFixture[str], face: Path) -> None:
    points = face.with_name("points.json")
    one, two = face.with_name("one.usda"), face.with_name("two.usda")
    points.write_text('{"l": 1, "r": 2}')
    done(capsys, "landmarks", face, "--from", points, "-o", one)
    points.write_text("[3, 4, 5]")
    done(capsys, "landmarks", one, "--from", points, "-o", two)
    landmarks = facepipe.open(two).landmarks("multipie68")[1]
    assert (landmarks.indices.tolist(), landmarks.names) == ([3, 4, 5], ())
    recipe = facepipe.open(two).parts().recipe
    assert recipe is not None
    assert (recipe.verb, recipe.sources) == ("landmarks", ("./one.usda", "./points.json"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("metersPerUnit = 0.01", "metersPerUnit = 0", "metersPerUnit 0"),
        ("metersPerUnit = 0.01", "metersPerUnit = nan", "metersPerUnit nan"),
        ('upAxis = "Y"', 'upAxis = "X"', "upAxis 'X'"),
        (f'"{facepipe.__version__}"', '"99.0.0"', "made by facepipe 99.0.0"),
        ("point3f[] points = [", "point3f[] points = [(", "tiny.usda:"),
    ],
)
def test_stages_of_other_conventions(
    capsys: pytest.CaptureFixture[str], face: Path, old: str, new: str, message: str
) -> None:
    text = face.read_text()
    assert old in text
    face.write_text(text.replace(old, new))
    assert message in failed(capsys, "inspect", face, folder=face.parent)


def test_a_full_or_closed_disk_is_one_line(tmp_path: Path) -> None:
    """Address-space limits stand for a full disk: files may not grow beyond 20 kB."""
    program = (
        "import resource, signal, sys\nfrom facepipe.cli import main\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "texels = {'a.usda': '0', 'a.usdc': '128', 'a.usdz': '128'}  # a side\n"
        "print([main(['sample', out, '--textures', number]) for out, number in texels.items()])\n"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "[2, 2, 2]\n", done.stderr[-500:]
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == ["facepipe"] * 3
    assert not list(tmp_path.iterdir())
