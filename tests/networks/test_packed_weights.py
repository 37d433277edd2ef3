"""Shipped networks hold a byte a weight, and give what they gave in four."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import code_of_training  # noqa: F401  (finds the modules of training/)
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from packed_weights import packed

from facepipe.networks.onnx_file import onnx_session

SHIPPED = ("dense_landmarks", "face_features", "face_mask", "landmarks")


def network(weights: np.ndarray, layer: np.ndarray) -> bytes:
    """A convolution with weights (o, i, 3, 3), its mean over the picture, and a layer (o, n)."""
    nodes = [
        helper.make_node("Conv", ["image", "weights"], ["found"], pads=[1, 1, 1, 1]),
        helper.make_node("ReduceMean", ["found"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("MatMul", ["mean", "layer"], ["seen"]),
    ]
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)]
        for name, shape in (("image", (1, weights.shape[1], 8, 8)), ("seen", (1, layer.shape[1])))
    ]
    constants = [numpy_helper.from_array(one, name) for one, name in ((weights, "weights"), (layer, "layer"))]
    graph = helper.make_graph(nodes, "network", *ends, initializer=constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def test_a_packed_network_gives_nearly_the_same_in_a_third_of_the_bytes() -> None:
    random = np.random.default_rng(0)
    weights = random.normal(size=(64, 32, 3, 3)).astype(np.float32)
    weights *= 10.0 ** random.integers(-4, 3, (64, 1, 1, 1))  # channels of all sizes
    weights[7] = 0.0
    plain = network(weights, random.normal(size=(64, 40)).astype(np.float32))
    small = packed(plain)
    assert len(small) < 0.35 * len(plain)
    picture = random.uniform(size=(1, 32, 8, 8)).astype(np.float32)
    seen, expected = (onnx_session(data).run(None, {"image": picture})[0] for data in (small, plain))
    np.testing.assert_allclose(seen, expected, atol=0.02 * np.abs(expected).max())
    kept = {tensor.name: numpy_helper.to_array(tensor) for tensor in onnx.load_from_string(small).graph.initializer}
    restored = kept["weights.whole"] * kept["weights.scale"]
    assert (np.abs(restored - weights).max(axis=(1, 2, 3)) <= 0.501 * kept["weights.scale"].ravel()).all()


def test_what_is_packed_is_packed_already() -> None:
    random = np.random.default_rng(1)
    given = (random.normal(size=shape).astype(np.float32) for shape in ((40, 8, 3, 3), (40, 40)))
    small = packed(network(*given))
    assert packed(small) == small


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_networks_have_no_large_weights_in_four_bytes(name: str) -> None:
    path = Path(str(files("facepipe.networks") / f"{name}.onnx"))
    assert packed(path.read_bytes()) == path.read_bytes()


def test_shipped_networks_take_at_most_seven_million_bytes() -> None:
    assert sum(Path(str(files("facepipe.networks") / f"{name}.onnx")).stat().st_size for name in SHIPPED) < 7_000_000
