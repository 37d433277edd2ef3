"""Whole ONNX networks as modules of torch: values and gradients, and files that can't be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from feature_graphs import Network, arcface_like, attribute_net, bisenet_like, make_model, reference, save
from import_data import refused
from onnx import TensorProto, helper, numpy_helper
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.networks.onnx_file import read_model
from facepipe.photo.features.onnx_module import OnnxModule

pytestmark = pytest.mark.needs_torch

NETWORKS = {"arcface": arcface_like, "bisenet": bisenet_like, "attributes": attribute_net}


def load(path: Path) -> OnnxModule:
    return OnnxModule(read_model(path), None, path)


def picture(size: int, count: int = 2) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, 3, size, size)).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "opset"),
    [
        *(("arcface", opset) for opset in (9, 11, 13, 17)),
        *(("bisenet", opset) for opset in (13, 17)),
        ("attributes", 17),
    ],
)
def test_network_as_onnxruntime(name: str, opset: int) -> None:
    model = NETWORKS[name](16, opset=opset)
    image = picture(16)
    for found, expected in zip(
        OnnxModule(model)(torch.from_numpy(image)), reference(model, {"image": image}), strict=True
    ):
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_network_has_the_gradient_of_finite_differences(name: str) -> None:
    module = OnnxModule(NETWORKS[name](8)).double()
    image = torch.from_numpy(picture(8, 1)).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda one: module(one), (image,), fast_mode=True)
    assert not list(module.parameters())


def test_inner_values_can_be_asked_for_and_the_rest_is_left_out() -> None:
    model = bisenet_like(16)
    inner = OnnxModule(model, ["v0", "shallow"])
    whole = OnnxModule(model)
    image = torch.from_numpy(picture(16))
    torch.testing.assert_close(inner(image)[1], whole(image)[0])
    assert inner(image)[0].shape == (2, 6, 8, 8)
    assert len(inner.state_dict()) < len(whole.state_dict())


def test_file_round_trip_and_initialisers_among_the_inputs(tmp_path: Path) -> None:
    model = attribute_net(16)
    image = picture(16)
    expected = reference(model, {"image": image})[0]
    for tensor in model.graph.initializer:  # as files of IR version 3 have it
        model.graph.input.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    module = load(save(model, tmp_path / "old.onnx"))
    assert module.inputs == ("image",)
    np.testing.assert_allclose(module(torch.from_numpy(image))[0].numpy(), expected, atol=1e-5)


def test_damaged_files_give_one_line(tmp_path: Path) -> None:
    whole = arcface_like().SerializeToString()
    contents = {"half": whole[: len(whole) // 2], "text": b"not ONNX at all", "empty": b"", "zeros": bytes(64)}
    contents["graphless"] = onnx.ModelProto(ir_version=8).SerializeToString()
    for name, content in contents.items():
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(content)
        with pytest.raises(InputError, match="ONNX file") as caught:
            load(path)
        assert str(path) in str(caught.value)
    with pytest.raises(InputError, match="can't be read"):
        load(tmp_path / "absent.onnx")


def test_any_truncation_is_an_input_error(tmp_path: Path) -> None:
    whole, path = arcface_like(8).SerializeToString(), tmp_path / "cut.onnx"
    count = 0
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            load(path)(torch.zeros(1, 3, 8, 8))
        count += 1
    assert count > 20


def test_any_flipped_byte_is_an_input_error_or_a_network(tmp_path: Path) -> None:
    """One line that names the file, or finite numbers: never another error, NaN or infinity."""
    whole, path = bytearray(arcface_like(8).SerializeToString()), tmp_path / "flipped.onnx"
    rng, image = np.random.default_rng(0), torch.from_numpy(picture(8, 1))
    found: list[tuple[torch.Tensor, ...]] = []

    def run() -> None:
        module = load(path)
        found.append(module(*[image] * len(module.inputs)))

    errors = 0
    for _ in range(150):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        errors += refused(run, path) is not None
    assert errors > 10
    assert len(found) == 150 - errors
    assert all(torch.isfinite(output).all() for outputs in found for output in outputs)


def test_external_data_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "outside.onnx"
    onnx.save_model(arcface_like(), str(path), save_as_external_data=True, size_threshold=0, location="weights.bin")
    with pytest.raises(InputError, match=r"outside\.onnx: tensor .* in another file, expected one file"):
        load(path)


def faulty(*nodes: Any, opset: int = 15, **weights: np.ndarray) -> Any:
    return make_model(nodes, {"x": [1, 2, 4, 4]}, {"y": TensorProto.FLOAT}, weights, opset)


def subgraph() -> Any:
    """A node with a graph of its own."""
    value = helper.make_tensor_value_info("one", TensorProto.FLOAT, [])
    constant = helper.make_node("Constant", [], ["one"], value_float=1.0)
    branch = helper.make_graph([constant], "branch", [], [value])
    return helper.make_node("If", ["c"], ["y"], name="choice", then_branch=branch, else_branch=branch)


node = helper.make_node
FAULTS = {
    "unknown operator": (
        faulty(node("STFT", ["x"], ["y"], name="spectrum")),
        "node 'spectrum': operator STFT: is not read, expected one of Add, .*Upsample$",
    ),
    "other domain": (faulty(node("Relu", ["x"], ["y"], name="n", domain="com.a")), "node 'n': .*domain 'com.a'"),
    "subgraph": (faulty(subgraph(), c=np.bool_(True)), "node 'choice': operator If"),
    "unknown input": (faulty(node("Add", ["x", "z"], ["y"])), "operator Add: input 'z'"),
    "no input": (faulty(node("Identity", [""], ["y"])), "operator Identity: input '', which"),
    "wrong order": (faulty(node("Relu", ["z"], ["y"]), node("Relu", ["x"], ["z"])), "operator Relu: input 'z'"),
    "made twice": (faulty(node("Relu", ["x"], ["y"]), node("Tanh", ["x"], ["y"])), "operator Tanh: output 'y'"),
    "no output": (faulty(node("Relu", ["x"], ["z"])), "output 'y'"),
    "NaN": (faulty(node("Add", ["x", "w"], ["y"]), w=np.float32([np.nan])), "tensor 'w': holds NaN"),
    "texts": (faulty(node("Add", ["x", "w"], ["y"]), w=np.array(["a", "b"], object)), "tensor 'w': of type"),
    "shapes": (
        faulty(node("MatMul", ["x", "w"], ["y"], name="m"), w=np.ones((3, 3), np.float32)),
        "node 'm': .*MatMul",
    ),
    "few inputs": (faulty(node("Conv", ["x"], ["y"], name="c")), "node 'c': operator Conv: can't work"),
    "bad axis": (faulty(node("Softmax", ["x"], ["y"], name="s", axis=9)), "node 's': operator Softmax"),
    "huge": (faulty(node("Expand", ["x", "w"], ["y"]), w=np.array([2**40, 1, 1, 1])), "operator Expand: a value of"),
    "negative": (faulty(node("ConstantOfShape", ["w"], ["y"]), w=np.array([-1, 2])), "ConstantOfShape: can't work"),
    "training": (
        faulty(node("BatchNormalization", list("xwwww"), ["y"], training_mode=1), w=np.ones(2, "f")),
        "training_mode",
    ),
    "resize": (faulty(node("Resize", ["x", "", "w"], ["y"], mode="quintic"), w=np.ones(4, "f") * 2), "mode quintic"),
    "crop": (
        faulty(
            node("Resize", ["x", "", "w"], ["y"], coordinate_transformation_mode="tf_crop_and_resize"),
            w=np.ones(4, "f"),
        ),
        "coordinate_transformation_mode tf_crop_and_resize",
    ),
    "cubic": (
        faulty(node("Resize", ["x", "", "w"], ["y"], mode="cubic"), w=np.ones(4, "f") * 2),
        "mode cubic, expected",
    ),
    "antialias": (
        faulty(node("Resize", ["x", "", "w"], ["y"], antialias=1), w=np.ones(4, "f") * 2, opset=18),
        "antialias 1, expected none",
    ),
    "rounding": (
        faulty(node("Resize", ["x", "", "w"], ["y"], nearest_mode="ceil"), w=np.ones(4, "f") * 2),
        "nearest_mode ceil",
    ),
    "one axis": (faulty(node("MaxPool", ["x"], ["y"], kernel_shape=[2])), r"windows \(2,\), expected"),
    "gaps": (
        faulty(node("AveragePool", ["x"], ["y"], kernel_shape=[2, 2], dilations=[2, 2]), opset=19),
        r"dilations \[2, 2\]",
    ),
    "overhang": (
        faulty(node("MaxPool", ["x"], ["y"], kernel_shape=[2, 2], pads=[0, 0, 1, 1], ceil_mode=1)),
        r"ceil_mode with pads \(0, 0, 1, 1\)",
    ),
    "lower": (faulty(node("MaxPool", ["x"], ["y"], kernel_shape=[2, 2], auto_pad="SAME_LOWER")), "auto_pad SAME_LOWER"),
    "mirrored": (
        faulty(node("Pad", ["x", "w"], ["y"], mode="reflect"), w=np.array([0, 0, 1, 1] * 2)),
        "mode reflect, expected constant",
    ),
    "parts": (faulty(node("Split", ["x", "w"], ["y"], axis=1), w=np.array([1, 1])), "2 parts, expected 1"),
    "mask": (faulty(node("Dropout", ["x"], ["z", "y"])), "output 'y': no value of the graph"),
    "old": (faulty(node("Relu", ["x"], ["y"]), opset=6), "operator set"),
    "new": (faulty(node("Relu", ["x"], ["y"]), opset=99), "operator set"),
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_what_cannot_be_run_is_named(name: str, tmp_path: Path) -> None:
    model, what = FAULTS[name]
    with pytest.raises(InputError, match=rf"faulty\.onnx.*{what}") as caught:
        load(save(model, tmp_path / "faulty.onnx"))(torch.ones(1, 2, 4, 4))
    assert "\n" not in str(caught.value)


def test_weights_of_a_wrong_size_are_refused() -> None:
    model = faulty(node("Add", ["x", "w"], ["y"]), w=np.ones(4, np.float32))
    model.graph.initializer[0].raw_data = b"\0" * 3
    with pytest.raises(InputError, match="tensor 'w': can't be read"):
        OnnxModule(model)
    half = numpy_helper.from_array(np.ones(4, np.float16), "w")
    model.graph.initializer[0].CopyFrom(half)
    assert OnnxModule(model)(torch.ones(1, 2, 4, 4))[0].dtype == torch.float32


def test_a_value_is_freed_after_its_last_use_but_kept_where_it_is_given() -> None:
    net = Network()
    net.add("Relu", net.add("Relu", net.add("Tanh", "image")), output="end")
    model = net.model(4, ["v0", "end"])
    image = torch.from_numpy(picture(4))
    found = OnnxModule(model)(image)
    torch.testing.assert_close(found, (torch.tanh(image), torch.relu(torch.tanh(image))))


def test_constants_follow_the_precision_of_the_module() -> None:
    weight = numpy_helper.from_array(np.float32([[0.5, 2.0], [1.0, -1.0], [3.0, 0.0], [0.0, 1.0]]))
    model = faulty(node("Constant", [], ["w"], value=weight), node("MatMul", ["x", "w"], ["y"]))
    (found,) = OnnxModule(model).double()(torch.ones(1, 2, 4, 4, dtype=torch.float64))
    torch.testing.assert_close(found[0, 0, 0], torch.tensor([4.5, 2.0], dtype=torch.float64))


_UNFOLDING = {
    "doubled": [helper.make_node("Concat", [f"v{i}", f"v{i}"], [f"v{i + 1}"], axis=0) for i in range(30)],
    "broadcast": [
        helper.make_node("Reshape", ["v0", "column"], ["a"]),
        helper.make_node("Reshape", ["v0", "row"], ["b"]),
        helper.make_node("Add", ["a", "b"], ["c"]),
        helper.make_node("Reshape", ["c", "row"], ["d"]),
        helper.make_node("Add", ["d", "a"], ["v30"]),
    ],
    "a shape of a shape": [
        helper.make_node("Shape", ["v0"], ["s"]),
        helper.make_node("Mul", ["s", "s"], ["s2"]),
        helper.make_node("Expand", ["one", "s2"], ["e"]),
        helper.make_node("Sqrt", ["e"], ["v30"]),
    ],
}


@pytest.mark.parametrize("name", _UNFOLDING)
def test_graphs_that_unfold_are_refused_before_they_run(name: str) -> None:
    """Counted on shapes alone: of a few megabytes more than memory holds, which no run gets to."""
    weights = {"column": np.array([-1, 1]), "row": np.array([1, -1]), "one": np.ones((1, 1, 1, 1), np.float32)}
    model = make_model(_UNFOLDING[name], {"v0": (1, 3, 256, 256)}, {"v30": TensorProto.FLOAT}, weights)
    with pytest.raises(InputError, match=r"numbers by then, expected at most|a value of \d+ numbers"):
        OnnxModule(model)(torch.zeros(1, 3, 256, 256))
