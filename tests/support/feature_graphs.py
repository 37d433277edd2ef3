"""Small ONNX graphs for the tests of feature extractors, and what onnxruntime makes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper


def make_model(
    nodes: Sequence[Any],
    inputs: Mapping[str, Sequence[int | str]],
    outputs: Mapping[str, int],
    weights: Mapping[str, np.ndarray] | None = None,
    opset: int = 15,
    properties: Mapping[str, str] | None = None,
) -> Any:
    """A model of float inputs by shape, outputs by type, and initialisers."""
    graph = helper.make_graph(
        list(nodes),
        "graph",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, kind, None) for name, kind in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in (weights or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    for key, value in (properties or {}).items():
        model.metadata_props.add(key=key, value=value)
    return model


def reference(model: Any, feeds: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """What onnxruntime gives."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return [np.asarray(one) for one in session.run(None, dict(feeds))]


class Network:
    """A graph that grows node by node, with random weights; methods give the name of the value they add."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.nodes: list[Any] = []
        self.weights: dict[str, np.ndarray] = {}

    def weight(self, value: np.ndarray) -> str:
        name = f"w{len(self.weights)}"
        self.weights[name] = np.asarray(value)
        return name

    def random(self, *shape: int, scale: float = 1.0, least: float | None = None) -> str:
        values = self.rng.normal(size=shape) * scale
        return self.weight((values if least is None else np.abs(values) + least).astype(np.float32))

    def add(self, op_type: str, *inputs: str, output: str | None = None, **attributes: object) -> str:
        name = output or f"v{len(self.nodes)}"
        self.nodes.append(
            helper.make_node(op_type, list(inputs), [name], name=f"{op_type}_{len(self.nodes)}", **attributes)
        )
        return name

    def conv(self, x: str, old: int, new: int, size: int = 3, stride: int = 1) -> str:
        weight = self.random(new, old, size, size, scale=(old * size * size) ** -0.5)
        return self.add("Conv", x, weight, kernel_shape=[size] * 2, strides=[stride] * 2, pads=[size // 2] * 4)

    def norm(self, x: str, count: int) -> str:
        parts = [self.random(count, least=0.5, scale=0.3), self.random(count, scale=0.1)]
        parts += [self.random(count, scale=0.1), self.random(count, least=0.5, scale=0.3)]
        return self.add("BatchNormalization", x, *parts)

    def prelu(self, x: str, count: int) -> str:
        return self.add("PRelu", x, self.random(count, 1, 1, scale=0.2))

    def relu(self, x: str) -> str:
        return self.add("Relu", x)

    def model(self, size: int | str, outputs: Sequence[str], batch: int | str = "batch", **options: Any) -> Any:
        kinds = dict.fromkeys(outputs, TensorProto.FLOAT)
        return make_model(self.nodes, {"image": [batch, 3, size, size]}, kinds, self.weights, **options)


def arcface_like(size: int = 16, **options: Any) -> Any:
    """Two residual blocks with PReLUs, then batch normalisation, dropout, flatten and a matrix: embedding (b, 8)."""
    net = Network()
    x = net.prelu(net.norm(net.conv("image", 3, 6), 6), 6)
    for _ in range(2):
        inner = net.prelu(net.norm(net.conv(net.norm(x, 6), 6, 6), 6), 6)
        inner = net.norm(net.conv(inner, 6, 6, stride=2), 6)
        x = net.add("Add", inner, net.norm(net.conv(x, 6, 6, size=1, stride=2), 6))
    flat = net.add("Flatten", net.add("Dropout", net.norm(x, 6)))
    dense = net.add("Gemm", flat, net.random(8, 6 * (size // 4) ** 2, scale=0.1), net.random(8), transB=1)
    parts = [net.random(8, least=0.5), net.random(8), net.random(8), net.random(8, least=0.5)]
    net.add("BatchNormalization", dense, *parts, output="embedding")
    return net.model(size, ["embedding"], **options)


def coarse_picture(size: int = 32) -> Any:
    """The picture itself, in cells of four pixels, as an embedding: grey is nothing."""
    net = Network()
    net.add("Flatten", net.add("AveragePool", "image", kernel_shape=[4, 4], strides=[4, 4]), output="embedding")
    return net.model(size, ["embedding"])


def bisenet_like(size: int = 32, classes: int = 11, softmax: bool = True, **options: Any) -> Any:
    """A trunk, attention by global pooling, two upsamplings: features (b, 6, s/4, s/4), classes (b, c, s, s)."""
    net = Network()
    x = net.relu(net.norm(net.conv("image", 3, 6, stride=2), 6))
    x = net.add("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    shallow = net.add("Relu", net.norm(net.conv(x, 6, 6), 6), output="shallow")
    deep = net.relu(net.norm(net.conv(shallow, 6, 8, stride=2), 8))
    attention = net.add("Sigmoid", net.conv(net.add("GlobalAveragePool", deep), 8, 8, size=1))
    deep = net.add("Mul", deep, attention)
    scales = net.weight(np.array([1, 1, 2, 2], np.float32))
    up = net.add(
        "Resize", deep, "", scales, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
    )
    both = net.add("Concat", net.conv(up, 8, 6, size=1), shallow, axis=1)
    logits = net.conv(both, 12, classes, size=1)
    height_width = net.add("Slice", net.add("Shape", "image"), *[net.weight(np.array([at])) for at in (2, 4, 0)])
    first = net.add("Slice", net.add("Shape", logits), *[net.weight(np.array([at])) for at in (0, 2, 0)])
    sizes = net.add("Concat", first, height_width, axis=0)
    mode = {"mode": "linear", "coordinate_transformation_mode": "align_corners"}
    name = None if softmax else "classes"
    full = net.add("Resize", logits, "", "", sizes, output=name, **mode)
    if softmax:
        net.add("Softmax", full, output="classes", axis=1)
    return net.model(size, ["shallow", "classes"], **options)


def attribute_net(size: int = 16, count: int = 5, sigmoid: bool = True, **options: Any) -> Any:
    """Convolutions with HardSwish, pooling, a matrix and a sigmoid: values (b, a)."""
    net = Network()
    x = net.add("HardSwish", net.norm(net.conv("image", 3, 8, stride=2), 8))
    x = net.add("AveragePool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1], count_include_pad=1)
    pooled = net.add("Reshape", net.add("ReduceMean", x, axes=[2, 3], keepdims=1), net.weight(np.array([0, -1])))
    values = net.add("MatMul", pooled, net.random(8, count, scale=3.0))
    if sigmoid:
        net.add("Sigmoid", values, output="values")
    else:
        net.add("Add", values, net.weight(np.full(count, 9, np.float32)), output="values")
    return net.model(size, ["values"], **options)


def save(model: Any, path: Any) -> Any:
    """The path of a model that was written there."""
    onnx.save_model(model, str(path))
    return path
