"""The file of a graph of sliders: operators, metadata, bytes, refusals, the command line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from command_line import done, failed
from facepipe_onnx import Deformer, Options, export_parts, validate
from faces import tiny_face
from slider_faces import jointless

from facepipe.core.errors import ExportError, InputError
from facepipe.parts import FaceParts, Slider
from facepipe.stage import save_parts

ALLOWED = set(
    "Clip Gemm MatMul Add Sub Mul Relu Tanh Sigmoid Sin Cos Concat Slice Reshape Transpose Gather".split()  # noqa: SIM905
)
CURVE = ((0.0, 0.0), (0.5, 0.8), (1.0, 1.0))
SLIDERS = (
    Slider(
        name="jawLeft",
        group="jaw",
        minimum=-1.0,
        value=0.25,
        channels=(("root/jaw", "rx", 0.5), ("root/jaw/lip", "tx", 0.2)),
        channel_curves=(CURVE, None),
        mirror="jawRight",
    ),
    Slider(name="jawRight", group="jaw", minimum=-1.0, channels=(("root/jaw", "rx", -0.5),), mirror="jawLeft"),
    Slider(name="smile", shapes=(("mouthSmileLeft", 0.9), ("jawOpen", 0.2)), shape_curves=(None, CURVE)),
)


def face(sliders: tuple[Slider, ...] = SLIDERS) -> FaceParts:
    return replace(tiny_face(), sliders=sliders)


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    export_parts(face(), tmp_path / "sliders.onnx", Options(sliders=True, pose="rest"))
    return tmp_path / "sliders.onnx"


@pytest.mark.parametrize("points", [False, True])
def test_graph_keeps_to_the_convention(points: bool, tmp_path: Path) -> None:
    path = tmp_path / "sliders.onnx"
    export_parts(face(), path, Options(sliders=True, pose="rest", points=points, parent=True))
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version == 8
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 15)]
    assert {node.op_type for node in model.graph.node} <= ALLOWED
    assert {value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)} == {1}
    assert [value.name for value in model.graph.input] == ["sliders", "weights", "parent"]
    outputs = ["coefficients", "skinning_matrices", "morph_weights", *(["points"] if points else [])]
    assert [value.name for value in model.graph.output] == outputs
    assert validate(path) == ()


def test_same_face_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        export_parts(face(), tmp_path / name / "s.onnx", Options(sliders=True, points=True))
    for file in ("s.onnx", "s.onnx.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert str(tmp_path).encode() not in (tmp_path / "a" / "s.onnx").read_bytes()


def test_sidecar_is_the_metadata_and_lists_the_sliders(exported: Path) -> None:
    beside = json.loads(exported.with_name("sliders.onnx.json").read_text())
    stored = {prop.key: json.loads(prop.value) for prop in onnx.load(exported).metadata_props}
    assert stored == {f"facepipe.{key}": value for key, value in beside.items()}
    sliders, weights = beside["inputs"]
    assert sliders["names"] == ["jawLeft", "jawRight", "smile"]
    assert sliders["range"] == [[-1.0, 1.0], [-1.0, 1.0], [0.0, 1.0]]
    assert (sliders["default"], sliders["values"]) == ([0.0, 0.0, 0.0], [0.25, 0.0, 0.0])
    assert sliders["groups"] == ["jaw", "jaw", ""]
    assert weights["names"] == ["jawOpen", "mouthSmileLeft"]
    first, second, smile = beside["sliders"]
    assert (first["mirror"], second["mirror"], smile["mirror"]) == ("jawRight", "jawLeft", None)
    assert first["channel_curves"] == [[list(knot) for knot in CURVE], None]
    assert smile["shape_curves"] == [None, [list(knot) for knot in CURVE]]
    outputs = {one["name"]: one for one in beside["outputs"]}
    joints = ["root", "root/jaw", "root/jaw/lip"]
    assert outputs["skinning_matrices"]["joints"] == outputs["coefficients"]["joints"] == joints
    assert len(outputs["coefficients"]["units"]) == 9
    names = [one["name"] for one in outputs["morph_weights"]["targets"]]
    assert sorted(names) == ["jawOpen", "jawOpen", "jawOpen_half", "mouthSmileLeft"]  # Teeth have no inbetween
    by_mesh = {one["name"]: [names[number] for number in one["targets"]] for one in beside["meshes"]}
    assert by_mesh == {"Head": ["jawOpen", "jawOpen_half", "mouthSmileLeft"], "Teeth": ["jawOpen"]}


def test_shape_globs_leave_out_what_sliders_do_to_the_others(tmp_path: Path) -> None:
    report = export_parts(face(), tmp_path / "s.onnx", Options(sliders=True, shapes="mouth*"))
    graph = Deformer(tmp_path / "s.onnx")
    assert graph.shapes == ("mouthSmileLeft",)
    assert graph.evaluate(sliders={"smile": 1.0})["morph_weights"] == pytest.approx([0.9])
    assert "shapes of sliders: 1" in report.dropped
    assert graph.metadata["sliders"][2]["shapes"] == [["mouthSmileLeft", 0.9]]


def test_what_can_not_be_exported(tmp_path: Path) -> None:
    path = tmp_path / "s.onnx"
    jaw = ("root/jaw", "rx", 0.5)
    refused: dict[str, tuple[Slider, ...]] = {
        "no sliders": (),
        "moves a joint or a shape": (Slider(name="idle"),),
        "is empty": (Slider(name="turned", minimum=1.0, maximum=0.0, channels=(jaw,)),),
        "no shape 'sneer'": (Slider(name="sneer", shapes=(("sneer", 1.0),)),),
        "no joint 'root/nose'": (Slider(name="nose", channels=(("root/nose", "rx", 1.0),)),),
        "rises and falls": (
            Slider(name="hill", channels=(jaw,), channel_curves=(((0.0, 0.0), (0.5, 1.0), (1.0, 0.0)),)),
        ),
        "2 curves of channels": (Slider(name="two", channels=(jaw,), channel_curves=(CURVE, CURVE)),),
        "float32": (Slider(name="huge", channels=(("root/jaw", "tx", 1e39),)),),
        "NaN": (Slider(name="lost", channels=(("root/jaw", "tx", np.nan),)),),
    }
    for message, sliders in refused.items():
        with pytest.raises((ExportError, InputError), match=message):
            export_parts(face(sliders), path, Options(sliders=True))
    with pytest.raises(ExportError, match="no joints"):
        export_parts(jointless(face(SLIDERS[2:])), path, Options(sliders=True, parent=True))
    with pytest.raises(InputError, match="no joint 'root/jaw'"):
        export_parts(jointless(face()), path, Options(sliders=True))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("word", "options"),
    [
        ("points", {"points": True}),
        ("inputs", {"sliders": True, "inputs": "matrices"}),
        ("joint_matrices", {"sliders": True, "joint_matrices": True}),
        ("normals", {"sliders": True, "normals": True}),
        ("batch", {"sliders": True, "batch": 0}),
        ("shapes", {"sliders": True, "shapes": "brow*"}),
    ],
)
def test_options_that_do_not_fit(word: str, options: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=word):
        export_parts(face(), tmp_path / "s.onnx", Options(**options))
    assert list(tmp_path.iterdir()) == []


def test_normals_with_points(tmp_path: Path) -> None:
    export_parts(face(), tmp_path / "s.onnx", Options(sliders=True, points=True, normals=True))
    found = Deformer(tmp_path / "s.onnx").evaluate(sliders={"jawLeft": 1.0})
    assert np.linalg.norm(found["normals"], axis=1) == pytest.approx(1.0, abs=1e-5)
    assert validate(tmp_path / "s.onnx") == ()


def _seeded() -> Iterator[tuple[str, Callable[[Any], None]]]:
    def replaced(key: str, old: str, new: str) -> Callable[[Any], None]:
        def change(model: Any) -> None:
            for entry in model.metadata_props:
                if entry.key == f"facepipe.{key}":
                    assert old in entry.value
                    entry.value = entry.value.replace(old, new)

        return change

    def no_matrices(model: Any) -> None:
        del model.graph.output[1]

    def other_operator(model: Any) -> None:
        model.graph.node[0].op_type = "Where"

    yield "OnnxMetadata", replaced("inputs", "jawRight", "jawLeft")
    yield "OnnxMetadata", replaced("format", "facepipe sliders", "facepipe deformer")
    yield "OnnxMetadata", replaced("format", "facepipe sliders", "sliders")
    yield "OnnxMetadata", no_matrices
    yield "OnnxOperators", other_operator


@pytest.mark.parametrize(("check", "change"), list(_seeded()))
def test_seeded_defects_are_found_and_refused(exported: Path, check: str, change: Callable[[Any], None]) -> None:
    model = onnx.load(exported)
    change(model)
    exported.write_bytes(model.SerializeToString())
    assert check in {finding.check.removeprefix("facepipe:") for finding in validate(exported)}
    with pytest.raises(InputError, match=r"sliders\.onnx"):
        Deformer(exported)


def test_names_and_inputs_are_checked(exported: Path) -> None:
    graph = Deformer(exported)
    assert graph.sliders == ("jawLeft", "jawRight", "smile")
    wrong: dict[str, dict[str, Any]] = {
        "jawleft": {"sliders": {"jawleft": 1.0}},
        "1 number": {"sliders": {"jawLeft": [1.0, 2.0]}},
        "no such input": {"coefficients": np.zeros((3, 9))},
        "float32": {"sliders": {"jawLeft": 1e300}},
    }
    for word, arguments in wrong.items():
        with pytest.raises(InputError, match=word):
            graph.evaluate(**arguments)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stage, model, out = (tmp_path / name for name in ("face.usda", "sliders.onnx", "out.npz"))
    save_parts(face(), stage)
    report = done(capsys, "export", stage, "--sliders", "--points", "-o", model, "--json", quiet=False)
    assert json.loads(report)["counts"]["sliders"] == 3
    done(capsys, "validate", model, quiet=False)
    words = ["--slider", "jawRight=0.5", "--slider", "smile=7", "--set", "jawOpen=0.1"]
    done(capsys, "eval", model, *words, "-o", out, quiet=False)
    expected = Deformer(model).evaluate({"jawOpen": 0.1}, sliders={"jawRight": 0.5, "smile": 1.0})
    with np.load(out) as arrays:
        assert set(arrays) == {"coefficients", "skinning_matrices", "morph_weights", "points"}
        for name, values in expected.items():
            assert np.array_equal(arrays[name], values)
    for words in (["--slider", "brow=1"], ["--slider", "smile=wide"], ["--bone", "jaw:rx=0.1"]):
        failed(capsys, "eval", model, *words, "-o", out, "--force", folder=tmp_path)
