"""The ONNX reference runtime and validation: wrong use, damaged and hostile models."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from facepipe_onnx import Deformer, Options, export_parts, validate
from faces import tiny_face
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import refused
from onnx import TensorProto, helper

from facepipe.core.errors import InputError


@pytest.fixture(scope="module")
def model_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("onnx") / "face.onnx"
    export_parts(tiny_face(), path, Options(normals=True, parent=True))
    return path.read_bytes()


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    export_parts(tiny_face(), tmp_path / "face.onnx")
    return tmp_path / "face.onnx"


def changed(path: Path, change: Callable[[Any], None]) -> Path:
    """The model at `path` after `change` of its ModelProto."""
    model = onnx.load(path)
    change(model)
    path.write_bytes(model.SerializeToString())
    return path


def checks(path: Path) -> set[str]:
    return {finding.check.removeprefix("facepipe:") for finding in validate(path)}


def test_names_and_shapes_are_checked(exported: Path) -> None:
    deformer = Deformer(exported)
    wrong: dict[str, dict[str, Any]] = {
        "jawopen": {"weights": {"jawopen": 1.0}},
        "jawOpen": {"weights": {"jawOpen": "wide"}},
        "coefficients": {"coefficients": np.zeros((2, 9))},
        "finite": {"coefficients": np.full((3, 9), np.nan)},
        "float32": {"weights": {"jawOpen": 1e300}},
        "root/nose": {"coefficients": {"root/nose": [0.0] * 9}},
        "9 numbers": {"coefficients": {"root/jaw": [0.0] * 8}},
        "joint_transforms": {"joint_transforms": np.zeros((3, 4, 4))},
        "parent": {"parent": np.eye(4)},
    }
    for word, arguments in wrong.items():
        with pytest.raises(InputError, match=word):
            deformer.evaluate(**arguments)


def test_coefficients_by_name_are_the_array(exported: Path) -> None:
    deformer = Deformer(exported)
    own = [0.1, 0.0, 0.2, 0.3, -0.2, 0.1, 1.1, 0.9, 1.0]
    array = np.tile([0.0] * 6 + [1.0] * 3, (3, 1))
    array[1] = own
    by_name = deformer.evaluate({"jawOpen": 0.5}, coefficients={"root/jaw": own})["points"]
    assert np.array_equal(by_name, deformer.evaluate({"jawOpen": 0.5}, coefficients=array)["points"])
    assert not np.allclose(by_name, deformer.evaluate({"jawOpen": 0.5})["points"])


def _seeded() -> Iterator[tuple[str, Callable[[Any], None]]]:
    def newer(model: Any) -> None:
        model.opset_import[0].version = 18

    def newer_file(model: Any) -> None:
        model.ir_version = 10

    def foreign_domain(model: Any) -> None:
        model.opset_import.append(helper.make_opsetid("com.microsoft", 1))
        model.graph.node[0].domain = "com.microsoft"

    def other_operator(model: Any) -> None:
        model.graph.node[0].op_type = "Loop"

    def subgraph(model: Any) -> None:
        body = helper.make_graph([], "body", [], [])
        model.graph.node[0].attribute.append(helper.make_attribute("body", body))

    def outside(model: Any) -> None:
        tensor = model.graph.initializer[0]
        tensor.data_location = TensorProto.EXTERNAL
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", "../../etc/passwd"
        tensor.ClearField("raw_data")

    def outside_quietly(model: Any) -> None:
        entry = model.graph.initializer[0].external_data.add()
        entry.key, entry.value = "location", "/etc/passwd"

    def huge_tensor(model: Any) -> None:
        model.graph.initializer[0].dims[:] = [1 << 40, 1 << 40]

    def negative_tensor(model: Any) -> None:
        model.graph.initializer[0].dims[:] = [-1]

    def text_tensor(model: Any) -> None:
        model.graph.initializer[0].data_type = TensorProto.STRING

    def not_a_number(model: Any) -> None:
        tensor = next(one for one in model.graph.initializer if one.data_type == TensorProto.FLOAT)
        tensor.raw_data = np.float32(np.nan).tobytes() + tensor.raw_data[4:]

    def bomb(model: Any) -> None:
        """Each node doubles the value before it."""
        last = "weights"
        for i in range(60):
            model.graph.node.append(helper.make_node("Concat", [last, last], [f"bomb{i}"], axis=1))
            last = f"bomb{i}"

    def huge_input(model: Any) -> None:
        for value in model.graph.input:
            value.type.tensor_type.shape.dim[0].dim_value = 1 << 50

    def open_input(model: Any) -> None:
        for value in model.graph.input:
            value.type.tensor_type.shape.dim[0].dim_param = "batch"

    def broken_graph(model: Any) -> None:
        model.graph.node[3].input[0] = "nowhere"

    def functions(model: Any) -> None:
        model.functions.add().name = "f"

    def no_metadata(model: Any) -> None:
        del model.metadata_props[:]

    def other_names(model: Any) -> None:
        for entry in model.metadata_props:
            entry.value = entry.value.replace("mouthSmileLeft", "jawOpen")

    def other_shape(model: Any) -> None:
        for entry in model.metadata_props:
            if entry.key == "facepipe.inputs":
                entry.value = entry.value.replace("[1, 2]", "[1, 3]")

    def no_joints(model: Any) -> None:
        for entry in model.metadata_props:
            if entry.key == "facepipe.joints":
                entry.value = '["root"]'

    def deep_json(model: Any) -> None:
        model.metadata_props[0].value = "[" * 100_000

    def undeclared(model: Any) -> None:
        for entry in model.metadata_props:
            if entry.key == "facepipe.operators":
                entry.value = json.dumps(["MatMul"])

    yield from [
        ("OnnxVersion", newer),
        ("OnnxVersion", newer_file),
        ("OnnxVersion", foreign_domain),
        ("OnnxOperators", foreign_domain),
        ("OnnxOperators", other_operator),
        ("OnnxOperators", subgraph),
        ("OnnxSelfContained", outside),
        ("OnnxSelfContained", outside_quietly),
        ("OnnxSelfContained", huge_tensor),
        ("OnnxSelfContained", negative_tensor),
        ("OnnxSelfContained", text_tensor),
        ("OnnxSelfContained", functions),
        ("OnnxFinite", not_a_number),
        ("OnnxChecker", broken_graph),
        ("OnnxSize", bomb),
        ("OnnxMetadata", no_metadata),
        ("OnnxMetadata", other_names),
        ("OnnxMetadata", other_shape),
        ("OnnxMetadata", no_joints),
        ("OnnxMetadata", deep_json),
        ("OnnxMetadata", undeclared),
        ("", huge_input),
        ("", open_input),
    ]


@pytest.mark.parametrize(("check", "change"), list(_seeded()), ids=lambda one: getattr(one, "__name__", one))
def test_seeded_defects_are_found_and_refused(exported: Path, check: str, change: Callable[[Any], None]) -> None:
    changed(exported, change)
    found = checks(exported)
    assert check in found if check else found
    with pytest.raises(InputError, match=r"face\.onnx") as caught:
        Deformer(exported)
    assert "\n" not in str(caught.value)


def test_sidecar_must_be_there_and_equal(exported: Path) -> None:
    assert validate(exported) == ()
    beside = exported.with_name("face.onnx.json")
    text = beside.read_text()
    beside.write_text(text.replace("jawOpen", "jawShut"))
    assert checks(exported) == {"OnnxSidecar"}
    beside.write_text("{")
    assert checks(exported) == {"OnnxSidecar"}
    beside.unlink()
    assert [finding.severity for finding in validate(exported)] == ["warning"]
    Deformer(exported)  # the model alone is enough to run


def test_indices_beyond_a_tensor_are_an_input_error(exported: Path) -> None:
    def far(model: Any) -> None:
        for tensor in model.graph.initializer:
            gathered = any(node.op_type == "Gather" and node.input[1] == tensor.name for node in model.graph.node)
            if tensor.data_type == TensorProto.INT64 and gathered:
                tensor.raw_data = np.full(tensor.dims[0], 1 << 40, np.int64).tobytes()

    changed(exported, far)
    with pytest.raises(InputError, match=r"face\.onnx"):
        Deformer(exported).evaluate()


@pytest.mark.parametrize("data", [b"", b"\0", b"not a model", b"\x08\x08", b"PK\x03\x04", b"\xff" * 100])
def test_files_that_are_no_models(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "face.onnx"
    path.write_bytes(data)
    for use in (validate, Deformer):
        with pytest.raises(InputError, match=r"face\.onnx"):
            use(path)
    for other in (tmp_path, tmp_path / "missing.onnx"):
        with pytest.raises(InputError):
            Deformer(other)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=st.data())
def test_damaged_models_raise_only_our_errors(model_bytes: bytes, tmp_path: Path, damage: st.DataObject) -> None:
    data = bytearray(model_bytes)
    where = st.integers(0, len(data) - 1)
    for _ in range(damage.draw(st.integers(1, 4))):
        data[damage.draw(where)] = damage.draw(st.integers(0, 255))
    if damage.draw(st.booleans()):
        start = damage.draw(where)
        del data[start : start + damage.draw(st.integers(1, 64))]
    if damage.draw(st.integers(0, 4)) == 0:
        del data[damage.draw(where) :]
    path = tmp_path / "face.onnx"
    path.write_bytes(data)
    refused(lambda: validate(path), path)
    refused(lambda: Deformer(path).evaluate(), path)
