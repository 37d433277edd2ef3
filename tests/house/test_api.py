"""The public functions: what the command line does, from Python, on any file that can be read."""

from __future__ import annotations

import inspect
import pickle
import pkgutil
import re
import shutil
from collections import UserList
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import content, exit_code
from faces import tiny_face
from small_head import lean, make

import facepipe
from facepipe.api import given, names
from facepipe.core.errors import InputError
from facepipe.stage import save_parts

SHAPES = ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthSmileLeft")


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("heads")
    for seed, name in enumerate("ab"):
        save_parts(lean(make(seed), *SHAPES), folder / f"{name}.usda")
    return folder


@pytest.fixture
def folder(heads: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with copies of those faces in it."""
    shutil.copytree(heads, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_functions_write_what_the_commands_write(folder: Path) -> None:
    facepipe.blend(["a.usda", "b.usda"], weights={"eyes": [0.8, 0.2]}, out="c.usda")
    facepipe.sliders("c.usda", values={"blink": 0.5}, out="d.usda")
    facepipe.export("d.usda", "d.glb", engine="unity")
    blend = ["blend", "a.usda", "b.usda", "--set", "eyes=0.8,0.2", "-o", "c.usda", "--force"]
    for name in ("c.usda", "d.usda", "d.glb"):
        Path(name).rename(f"python.{name}")
    Path("python.c.usda").rename("c.usda")
    first = Path("c.usda").read_bytes()
    assert exit_code(*blend) == 0
    assert Path("c.usda").read_bytes() == first
    assert exit_code("sliders", "c.usda", "--set", "blink=0.5", "-o", "d.usda") == 0
    assert Path("d.usda").read_bytes() == Path("python.d.usda").read_bytes()
    assert exit_code("export", "d.usda", "-o", "d.glb", "--engine", "unity") == 0
    assert Path("d.glb").read_bytes() == Path("python.d.glb").read_bytes()


def test_any_file_is_a_face_and_any_result_is_for_the_engine(folder: Path) -> None:
    """GLB in, GLB and ONNX out: points stay, textures and shapes too."""
    facepipe.export("a.usda", "a.glb")
    face = facepipe.read("a.glb")
    assert face.shapes == facepipe.open("a.usda").shapes
    facepipe.export(face, "again.glb")
    assert facepipe.read("again.glb").materials == face.materials
    report = facepipe.blend(["a.glb", "b.usda"], weights={"default": [1, 0]}, out="whole.usdc")
    assert len(report.sources) == 2
    np.testing.assert_allclose(facepipe.open("whole.usdc").evaluate(), face.evaluate(), atol=1e-4)
    assert exit_code("blend", "a.glb", "b.usda", "--default", "1,0", "-o", "whole.glb", "--json") == 0
    np.testing.assert_allclose(facepipe.read("whole.glb").evaluate(), face.evaluate(), atol=1e-4)
    assert facepipe.blend(["a.usda", "b.usda"], out="mix.onnx")
    assert not [one for one in facepipe.validate("mix.onnx") if one.severity == "error"]
    assert exit_code("inspect", "a.glb") == 0
    assert {one.name for one in folder.iterdir()} >= {"whole.glb", "mix.onnx", "mix.onnx.json"}
    assert exit_code("cook", "whole.usdc") == 0


def test_exports_do_what_the_command_does(folder: Path) -> None:
    report = facepipe.export("a.usda", "a.glb", rename="vrm")
    assert exit_code("export", "a.usda", "-o", "line.glb", "--rename", "vrm") == 0
    assert Path("a.glb").read_bytes() == Path("line.glb").read_bytes()
    assert report.renamed["eyeBlinkLeft"] == "blinkLeft"
    for wrong, message in {
        "morph_normal": "option morph_normal: is unknown, did you mean 'morph_normals'?",
        "keep_shapes": "--keep-shapes: given without --neural, expected both",
        "distil_steps": "--distil-steps: given without --distil, expected both",
    }.items():
        with pytest.raises(facepipe.InputError, match=re.escape(message)):
            facepipe.export("a.usda", "b.glb", **{wrong: True})
    assert not Path("b.glb").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        pytest.param({"heatmap": "c.jpg"}, "c.jpg: suffix '.jpg', expected .png", id="a picture of another suffix"),
        pytest.param(
            {"static_mm": (3.0,)}, "option static_mm: is (3.0,), expected a number", id="a list of one number"
        ),
        pytest.param(
            {"edges": ["uniform"]}, "option edges: is ('uniform',), expected one of", id="a list of one choice"
        ),
        pytest.param({"sources": []}, "SOURCE: none given", id="no sources"),
        pytest.param({"sources": "abc"}, "abc: suffix ''", id="a source that is a name alone"),
    ],
)
def test_what_the_command_refuses_the_function_does(folder: Path, given: dict[str, Any], message: str) -> None:
    before = content(folder)
    with pytest.raises(facepipe.InputError, match=re.escape(message)):
        facepipe.blend(**{"sources": ["a.usda", "b.usda"], "out": "c.usda", **given})
    assert content(folder) == before


def test_a_file_alone_is_a_list_of_one(folder: Path) -> None:
    for name, sources in {"one.usda": "a.usda", "list.usda": ["a.usda"]}.items():
        facepipe.blend(sources, out=name)
    assert Path("one.usda").read_bytes() == Path("list.usda").read_bytes()
    assert facepipe.cook("one.usda").nodes == facepipe.cook(["one.usda"]).nodes


def test_words_that_name_files_may_be_paths_and_lists_any_sequence(folder: Path) -> None:
    save_parts(tiny_face(), folder / "rig.usda")
    save_parts(tiny_face(1), folder / "smile.usda")
    given = {"text.usda": "smile.usda", "path.usda": Path("smile.usda"), "list.usda": UserList([Path("smile.usda")])}
    for out, targets in given.items():
        facepipe.fit_bones("rig.usda", targets=targets, mask=UserList(["mouth"]), max_iterations=1, out=out)
    assert len({(folder / out).read_bytes() for out in given}) == 1


def test_a_result_from_a_file_that_is_imported_is_cooked_again(folder: Path) -> None:
    facepipe.export("a.usda", "a.glb")
    facepipe.blend(["a.glb", "b.usda"], weights={"default": [0.5, 0.5]}, out="mix.usda")
    facepipe.export("b.usda", "a.glb", overwrite=True)
    assert [node.action for node in facepipe.cook(["mix.usda"]).nodes] == ["cooked"]
    np.testing.assert_allclose(facepipe.open("mix.usda").evaluate(), facepipe.open("b.usda").evaluate(), atol=1e-3)


def test_nothing_is_overwritten_unasked_and_no_input_ever(folder: Path) -> None:
    for call in (
        lambda: facepipe.sample("a.usda"),
        lambda: facepipe.sliders("a.usda", values={"blink": 1}, out="b.usda"),
        lambda: facepipe.sliders("a.usda", values={"blink": 1}, out="a.usda", overwrite=True),
        lambda: facepipe.sliders("a.usda", values={"blink": 1}, out="x.txt"),
        lambda: facepipe.sliders("a.usda", values={"blink": 1}, out=folder / "none" / "x.usda"),
        lambda: facepipe.sliders("a.ply", values={"blink": 1}, out="x.usda"),
        lambda: facepipe.read("b.xyz"),
    ):
        before = {one.name: one.stat().st_mtime_ns for one in folder.iterdir()}
        with pytest.raises(facepipe.InputError) as caught:
            call()
        assert "\n" not in str(caught.value)
        assert {one.name: one.stat().st_mtime_ns for one in folder.iterdir()} == before


@pytest.mark.parametrize("name", sorted({*names()} - {*facepipe.__all__}))  # sample gives the face, no report
def test_a_function_says_what_it_takes(name: str) -> None:
    function = given(name)
    assert function is not None
    assert getattr(facepipe, name) is function
    parameters = inspect.signature(function).parameters
    if "out" in parameters:  # else it writes nothing
        assert parameters["out"].kind is inspect.Parameter.KEYWORD_ONLY
    assert function.__doc__ is not None
    assert all(f":param {one}: " in function.__doc__ for one in parameters)


def test_no_function_is_called_as_a_room() -> None:
    rooms = {iter_module.name for iter_module in pkgutil.iter_modules(facepipe.__path__)}
    assert not rooms & {*facepipe.__all__, *names()}
    assert {*facepipe.__all__, *names()} <= {*dir(facepipe)}


def test_errors_come_whole_from_other_processes() -> None:
    error = InputError("head.usda -> jawOpen", "51 offsets, expected 52").under("batch")
    other = pickle.loads(pickle.dumps(error))
    assert (type(other), str(other)) == (InputError, "batch -> head.usda -> jawOpen: 51 offsets, expected 52")
    assert (other.where, other.what) == (error.where, error.what)
